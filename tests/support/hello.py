"""The reply to `hello`, for servers that tests script."""

from __future__ import annotations

from typing import Any

import mujoco

__all__ = ["hello_ok"]


def hello_ok(**entries: Any) -> dict[str, Any]:
    """Return one without robots, with entries added or replaced."""
    return {
        "op": "hello_ok",
        "session_id": "11111111-2222-3333-4444-555555555555",
        "urlab_version": "urlab/0.1",
        "mujoco_version_int": float(mujoco.mj_version()),
        "mujoco_version": mujoco.mj_versionString(),
        "manager_present": True,
        "articulations": [],
        **entries,
    }
