"""Advice for agents: what the client says names methods, and agents have tools."""

from __future__ import annotations

__all__ = ["for_agents"]

_TOOLS = {
    "runtime.set_paused(False)": "play with action='resume'",
    "sim.start()": "play with action='start'",
    "set_ctrl() or ctrl_array before step()": "set_actuators before run",
    "step() was not called": "run was not called",
    "waiting for step()": "waiting for run",
    "Call reset()": "Call reset",
}


def for_agents(text: str) -> str:
    """Return a text of the client's in which methods are the tools that do the same."""
    for method, tool in _TOOLS.items():
        text = text.replace(method, tool)
    return text
