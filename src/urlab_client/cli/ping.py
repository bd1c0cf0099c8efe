"""`urlab ping`: show which server answers at an address, and how fast.

Show which server answers at an address: versions, play state and step mode, articulations, and the round-trip times of
`meta`. This opens a session, which takes the server over from the client that drives it. --no-session reads only the op
list and the round-trip times, and does not disturb other clients.
"""

from __future__ import annotations

import asyncio
import socket
import statistics
import time
from argparse import Namespace
from contextlib import suppress
from typing import Any

from urlab_client import aio
from urlab_client.aio.explain import watched
from urlab_client.aio.launch import SCHEME
from urlab_client.cli._arguments import SESSIONLESS, address_usage, make_client
from urlab_client.cli._common import aligned, counted, import_mujoco, json_line
from urlab_client.errors import ModeLocked, URLabConnectionError, URLabRPCError, URLabTimeoutError, URLabVersionMismatch
from urlab_client.protocol.instances import RegisteredInstance, decode, registry_directory
from urlab_client.protocol.messages.runtime import SetMode

_CONCURRENT = 16

USAGE = f"""
{address_usage()}
--timeout SECONDS=2  how long to wait for each reply
--count N=5  round trips to time
--no-session  do not open a session, so that no client is disturbed
--all  list the servers in this machine's registry (which the plugin's beta writes), and check whether each answers;
    does not disturb other clients
--json  print one line of JSON
{SESSIONLESS}
examples:
urlab ping  the server on this machine: versions, play state, robots, round trip
urlab ping 192.168.1.20:5559 --no-session  another machine, without taking over its session
urlab ping --all  every server that this machine's registry lists
"""


def run(arguments: Namespace) -> int:
    """Print a report on the server, or on those of the registry."""
    if not (arguments.all or arguments.no_session):
        import_mujoco()  # beforehand: a slow import would block the event loop
    look, show = (_registered, _list) if arguments.all else (_ping, _text)
    found: Any = asyncio.run(look(arguments))
    print(json_line(found) if arguments.json else show(found))
    return 0


async def _registered(arguments: Namespace) -> list[dict[str, Any]]:
    """Return the servers of the registry; `answers` is None for one on another machine, which is not contacted."""
    concurrent = asyncio.Semaphore(_CONCURRENT)  # one by one, the timeouts of dead servers would add up

    async def server(instance: RegisteredInstance, written: float) -> dict[str, Any]:
        local = instance.host in ("", socket.gethostname())
        address = f"tcp://{'127.0.0.1' if local else instance.host}:{instance.step_port}"
        async with concurrent:
            answers = await _answers(address, arguments.timeout) if local else None
        return {
            "instance_id": instance.instance_id,
            "address": address,
            "pid": instance.pid,
            "seen_s_ago": round(max(0.0, time.time() - written), 1),
            "busy": instance.busy,
            "answers": answers,
        }

    entries: list[tuple[RegisteredInstance, float]] = []
    for path in sorted(registry_directory().glob("*.json")):
        with suppress(OSError, ValueError):  # deleted meanwhile, or not written by a server
            entries.append((decode(path.read_bytes()), path.stat().st_mtime))
    return await asyncio.gather(*(server(instance, written) for instance, written in entries))


async def _answers(address: str, timeout: float) -> bool:
    async with aio.URLabClient(address, rcv_timeout_ms=_milliseconds(timeout), local_model=False) as client:
        try:
            await client.meta(timeout=timeout)
        except (URLabConnectionError, URLabTimeoutError):
            return False
    return True


def _list(servers: list[dict[str, Any]]) -> str:
    if not servers:
        return f"The registry {registry_directory()} lists no servers."
    answers = {True: "answers", False: "does not answer", None: "on another machine"}
    return aligned(
        [
            (
                server["instance_id"],
                server["address"],
                f"pid {server['pid']}",
                answers[server["answers"]] + (", in use" if server["busy"] else ""),
                f"registered {server['seen_s_ago']:.0f} s ago",
            )
            for server in servers
        ]
    )


async def _ping(arguments: Namespace) -> dict[str, Any]:
    """Return the report; `server` is None without a session."""
    options: dict[str, Any] = {"rcv_timeout_ms": _milliseconds(arguments.timeout)}
    async with make_client(aio.URLabClient, arguments.address, arguments, **options) as client:
        ops = len(await client.meta(timeout=arguments.timeout))
        trips = await _round_trips(client, arguments)
        report = {"address": arguments.address, "ops": ops, "round_trip_ms": trips, "server": None}
        if arguments.no_session:
            return report
        try:
            await client.discover()
            return {**report, "server": await _identity(client)}
        except URLabVersionMismatch:
            async with make_client(
                aio.URLabClient, arguments.address, arguments, local_model=False, **options
            ) as other:
                await other.discover()
                return {**report, "server": await _identity(other)}


def _milliseconds(timeout: float) -> int:
    return max(1, round(timeout * 1000))


async def _round_trips(client: aio.URLabClient, arguments: Namespace) -> dict[str, float]:
    times: list[float] = []
    for _ in range(arguments.count):
        start = time.perf_counter()
        await client.meta(timeout=arguments.timeout)
        times.append(1e3 * (time.perf_counter() - start))
    spread = {"min": min(times), "median": statistics.median(times), "max": max(times)}
    return {"count": len(times), **{name: round(value, 3) for name, value in spread.items()}}


async def _identity(client: aio.URLabClient) -> dict[str, Any]:
    import mujoco

    local = mujoco.mj_versionString()
    return {
        "urlab_version": client.urlab_version,
        "mujoco_version": client.mujoco_version,
        "local_mujoco_version": local,
        "same_mujoco_build": client.mujoco_version == local,
        "play": await _play(client),
        "articulations": [_articulation(art, client.model is not None) for art in client.articulations.values()],
        "entities": [name for name in client.entities if name not in client.articulations],
    }


def _articulation(articulation: aio.URLabArticulation, with_model: bool) -> dict[str, Any]:
    """Return what an articulation has; joints and sensors are None if the model could not be loaded locally."""
    controller = articulation.controller
    return {
        "key": articulation.prefix,
        "actor_id": articulation.actor_id,
        "joints": len(articulation.joints) if with_model else None,
        "actuators": len(articulation.actuators),
        "sensors": len(articulation.sensors) if with_model else None,
        "cameras": len(articulation.cameras),
        "controller": None if controller is None else str(controller.kind),
    }


async def _play(client: aio.URLabClient) -> dict[str, Any]:
    """Return the state of play; `step_mode` is None if only the driving client knows it."""
    play = {"state": "off", "sim_time": None, "physics": None, "step_mode": None, "step_mode_pinned": False}
    try:
        before = await client.sim.status()
    except URLabRPCError:  # a packaged build has no such op
        return {**play, "state": "ready" if client.manager_present else "off"}
    if before.sim_time is None or not client.manager_present:
        return {**play, "state": before.state, "sim_time": before.sim_time}
    after = await watched(client.sim.status, before)
    advancing = after.sim_time is not None and after.sim_time > before.sim_time
    pinned = await _pinned_mode(client)
    return {
        "state": before.state,
        "sim_time": after.sim_time,
        "physics": "advancing" if advancing else "standing still",
        "step_mode": pinned or ("live" if advancing else None),
        "step_mode_pinned": pinned is not None,
    }


async def _pinned_mode(client: aio.URLabClient) -> str | None:
    """Return the mode the server is pinned to; no op reads the mode, but a pinned server names it in its refusal."""
    try:
        await client.call(SetMode(mode="?"))  # not a mode, so it changes nothing on any server
    except ModeLocked as locked:
        return locked.pinned or "unknown"
    except URLabRPCError:
        return None
    return None


def _text(report: dict[str, Any]) -> str:
    rows = [("ops", str(report["ops"]))]
    server = report["server"]
    if server is not None:
        here = "same version here" if server["same_mujoco_build"] else f"{server['local_mujoco_version']} here"
        rows = [("URLab", server["urlab_version"]), ("MuJoCo", f"{server['mujoco_version']} ({here})"), *rows]
        rows += _play_rows(**server["play"])
        articulations = [_articulation_text(art) for art in server["articulations"]]
        for title, texts in (("articulations", articulations), ("entities", server["entities"])):
            rows += [("" if index else title, text) for index, text in enumerate(texts)]
    trip = "min {min:.2f} ms, median {median:.2f} ms, max {max:.2f} ms ({count} times meta)"
    rows.append(("round trip", trip.format(**report["round_trip_ms"])))
    lines = [report["address"], *(f"  {title:13}  {text}" for title, text in rows)]
    if server is not None and not report["address"].startswith(SCHEME):
        lines.append(
            "A session was opened: a client that was driving this server has to call discover() again; "
            "--no-session avoids that."
        )
    return "\n".join(lines)


def _play_rows(
    state: str, sim_time: float, physics: str | None, step_mode: str | None, step_mode_pinned: bool
) -> list[tuple[str, str]]:
    if physics is None:
        return [("play", state)]
    mode = f"{step_mode}, pinned by the server" if step_mode_pinned else step_mode
    return [
        ("play", f"{state}, sim time {sim_time:.3f} s, {physics}"),
        ("step mode", mode or "live and paused, or a mode in which its client steps"),
    ]


def _articulation_text(articulation: dict[str, Any]) -> str:
    numbers = ((noun, articulation[f"{noun}s"]) for noun in ("joint", "actuator", "sensor", "camera"))
    counts = [counted(number, noun) for noun, number in numbers if number is not None]
    control = f"{articulation['controller']} controller" if articulation["controller"] else "no controller"
    actor = f" (actor {articulation['actor_id']})" if articulation["actor_id"] else ""
    return f"{articulation['key']}{actor}: {', '.join([*counts, control])}"
