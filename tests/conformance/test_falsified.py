"""The checks are not blind: of everything that is falsified, one thing at a time, they name the statement."""

from __future__ import annotations

import asyncio
import itertools
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from falsifier import (
    EndedJobs,
    Falsifier,
    Fields,
    InLive,
    Kept,
    Previous,
    SameJob,
    drop,
    each,
    failing,
    in_reply,
    in_request,
    in_state,
    narrowed,
    put,
    refusal,
)
from targets import bench, furnish, server

from urlab_client.conformance import Choice, Group, Verdict, run
from urlab_client.server import SimulatedServer


def turned(quaternion: list[float]) -> list[float]:
    return [*quaternion[1:], quaternion[0]]


def bodies(state: Fields) -> None:
    for body in state.get("bodies", {}).values():
        body["xquat"] = turned(body["xquat"])


def pictures(change: Any) -> Any:
    return in_reply("step_ok", lambda reply: [change(one) for one in (reply.get("cameras") or {}).values()] and None)


def robots(change: Any) -> Any:
    return in_reply("hello_ok", lambda reply: [change(one) for one in reply["articulations"]] and None)


def instance(change: Any) -> Any:
    return in_reply("hello_ok", lambda reply: change(reply["instance"]) and None)


def imported(change: Any) -> Any:
    """Change the result of an import that failed."""
    return in_reply("op_status_ok", lambda reply: change(reply["result"]) and None if "result" in reply else None)


def commands(change: Any) -> Any:
    return in_request("step", lambda request: [change(one) for one in request.get("per_articulation", {}).values()])


def unguarded(request: Fields, reply: Fields, *, only: str = "") -> object:
    """Say that a step was taken where the server refused it, for all commands or those with one field."""
    if request.get("op") != "step" or reply.get("code") != "not_control_owner":
        return None
    if only and not any(only in command for command in request["per_articulation"].values()):
        return None
    clock = {"sec": 0.0, "nsec": 0.0}
    taken: Fields = {"op": "step_ok", "time": 0.0, "step": 0.0, "sim_time": clock, "wall_time": clock}
    return msgspec.msgpack.encode({**taken, "frame_id": 1.0, "arts": {}, "scene": {}})


def earlier_cameras(request: Fields, reply: Fields) -> None:
    """Leave out a picture that is asked for as the latest."""
    if "latest" in (request.get("include_cameras") or {}).values():
        reply.pop("cameras", None)


def any_picture(chosen: Fields) -> Fields:
    return {name: "latest" if isinstance(how, dict) else how for name, how in chosen.items()}


def unknown_fields(request: Fields, _: Fields) -> object:
    """Refuse a request with a field that the op does not have."""
    error = {"op": "error", "code": "bad_request", "message": "falsified"}
    return msgspec.msgpack.encode(error) if "no_such_field" in request else None


_seconds = itertools.count()


def passing(reply: Fields) -> None:
    """Give every reply a later time."""
    reply["time"] = float(next(_seconds))


def kept_actor(request: Fields, reply: Fields) -> None:
    """Say that an actor was removed that is still there."""
    if request.get("op") == "destroy_actor":
        reply.update(op="destroy_actor_ok")


def touched(reply: Fields) -> None:
    """Add a contact with a body that is not there."""
    names = {"body1": "nobody", "body2": "", "geom1": "", "geom2": ""}
    contact = {**names, "pos": [0.0] * 3, "normal": [0.0, 0.0, 1.0], "dist": 0.0, "force": [0.0] * 3}
    reply["contacts"] = [{**one, "body1": "nobody"} for one in reply["contacts"]] or [contact]


def whole_number(reply: Fields) -> bytes:
    return msgspec.msgpack.encode({**reply, "step": int(reply["step"])})


def in_snapshot(change: Any) -> Any:
    def apply(_: str, topic: bytes, payload: bytes) -> tuple[bytes, bytes]:
        if topic != b"state/full":
            return topic, payload
        snapshot = msgspec.msgpack.decode(payload)
        change(snapshot)
        return topic, msgspec.msgpack.encode(snapshot)

    return apply


def in_topic(old: bytes, new: bytes) -> Any:
    return lambda _, topic, payload: (topic.replace(old, new), payload)


def in_row(kind: bytes, change: Any) -> Any:
    return lambda _, topic, payload: (topic, change(payload) if kind in topic else payload)


def swapped(payload: bytes) -> bytes:
    return payload[:12] + payload[24:28] + payload[12:24] + payload[28:]


def in_header(offset: int, layout: str, value: float) -> Any:
    def apply(source: str, topic: bytes, payload: bytes) -> tuple[bytes, bytes]:
        if source != "camera":
            return topic, payload
        data = bytearray(payload)
        struct.pack_into(layout, data, offset, value)
        return topic, bytes(data)

    return apply


def narrow(value: float) -> float:
    return float(np.float32(value))


ANY = "alpha"
FALSIFIED: dict[str, tuple[str, str, dict[str, Any]]] = {
    # Steps and their replies
    "the sign of qvel": (ANY, "Session 10.2", {"reply": in_state(each("qvel", lambda v: [-x for x in v]))}),
    "the order of the quaternion in qpos": (
        ANY,
        "Session 10.2",
        {"reply": in_state(each("qpos", lambda v: [*v[:3], *turned(v[3:7]), *v[7:]]))},
    ),
    "qpos in single precision": (ANY, "Session 10.2", {"reply": in_state(each("qpos", lambda v: [*map(narrow, v)]))}),
    "one position": ("beta", "Session 10.2", {"reply": in_state(each("qpos", lambda v: [*v[:-1], v[-1] + 1e-6]))}),
    "controls that are not applied": ("beta", "Session 10.2", {"request": commands(drop("ctrl"))}),
    "a reply of the step before": (ANY, "Session 9.3.2", {"reply": in_reply("step_ok", Previous())}),
    "one substep for all": (ANY, "Simulation 2.4", {"request": in_request("step", put("n_steps", 1))}),
    "a step counter that is one ahead": (
        "beta",
        "Session 9.3.2",
        {"reply": in_reply("step_ok", each("step", lambda v: v + 1))},
    ),
    "a time that stands still": (ANY, "Session 9.3.2", {"reply": in_reply("step_ok", put("time", 0.0))}),
    "a wrench that is ignored": (ANY, "Session 9.3.2", {"request": commands(drop("xfrc_applied"))}),
    "a torque in the place of a force": (
        "beta",
        "Beta 38",
        {"request": commands(each("xfrc_applied", lambda v: {k: [*w[3:], *w[:3]] for k, w in v.items()}))},
    ),
    "sensors that read nothing": (
        ANY,
        "Simulation 8",
        {"reply": in_state(each("sensors", lambda v: {name: [0.0] * len(one) for name, one in v.items()}))},
    ),
    "a sensor that is missing": ("beta", "Session 8.2", {"reply": in_state(each("sensors", lambda _: {}))}),
    "the order of a body's quaternion": (ANY, "Session 8.2", {"reply": in_state(bodies)}),
    "forces that are missing at full": ("beta", "Session 8.2", {"reply": in_state(drop("actuator_force"))}),
    "set-points by name that are ignored": (ANY, "Session 10.1", {"request": commands(drop("ctrl_map"))}),
    "set-points in double precision": (
        ANY,
        "Session 10.1",
        {"reply": in_state(each("ctrl", lambda v: [round(x, 6) for x in v]))},
    ),
    "set-points in single precision": (
        "beta",
        "Beta 35",
        {"reply": in_state(each("ctrl", lambda v: [*map(narrow, v)]))},
    ),
    "the server's UTC": (
        ANY,
        "Session 8.1",
        {"reply": in_reply("step_ok", put("wall_time", {"sec": 0.0, "nsec": 0.0}))},
    ),
    "seconds without their nanoseconds": (
        "beta",
        "Session 8.1",
        {"reply": in_reply("step_ok", lambda r: r["sim_time"].update(nsec=0.0))},
    ),
    "a reset that keeps the velocities": (
        ANY,
        "Session 9.4",
        {"reply": in_state(each("qvel", lambda v: [x + 0.5 for x in v]), "reset_ok")},
    ),
    "a reset that counts on": (ANY, "Session 9.4", {"reply": in_reply("reset_ok", put("step", 10.0))}),
    "a keyframe that is taken for another": (
        ANY,
        "Session 9.4",
        {"request": in_request("reset", put("keyframe_name", ""))},
    ),
    "an unknown keyframe's code": (
        ANY,
        "Session 9.4",
        {"reply": in_reply("error:unknown_keyframe", put("code", "bad_value"))},
    ),
    "joints that a reset ignores": (
        "beta",
        "Session 9.4",
        {"request": in_request("reset", drop("per_articulation_qpos"))},
    ),
    "a forward that takes a step": (
        ANY,
        "Session 9.5",
        {"reply": in_reply("forward_ok", each("time", lambda v: v + 0.002))},
    ),
    "a push that is ignored": (ANY, "Session 9.3.3", {"request": in_request("step", drop("qvel"))}),
    "a push that keeps the time": (
        "beta",
        "Beta 40",
        {"request": in_request("step", lambda r: r.setdefault("time", 3.0))},
    ),
    # Fields and numbers
    "a number as float32": (ANY, "Session 3.1", {"reply": in_reply("step_ok", narrowed)}),
    "a number as an integer": ("beta", "Session 3.1", {"reply": in_reply("step_ok", whole_number)}),
    "a field that nobody declared": (ANY, "Fields 1", {"reply": in_reply("hello_ok", put("mood", 1.0))}),
    "a field of another type": ("beta", "Fields 1", {"reply": in_reply("list_actors_ok", put("in_pie", "no"))}),
    "a field that is missing": ("beta", "Beta 30", {"reply": in_reply("step_ok", drop("sim_time"))}),
    "a required field that is missing": (ANY, "Fields 1", {"reply": in_reply("current_level_ok", drop("level_path"))}),
    "the alpha's name of the states": (
        "beta",
        "Beta 30",
        {"reply": in_reply("step_ok", lambda r: r.update(per_articulation=r["arts"]))},
    ),
    "a frame id after a reset": ("beta", "Beta 31", {"reply": in_reply("reset_ok", put("frame_id", 1.0))}),
    "a frame id that is stuck": ("beta", "Beta 32", {"reply": in_reply("step_ok", Kept("frame_id"))}),
    "a level that stays": ("beta", "Beta 36", {"request": in_request("step", put("observations", "full"))}),
    "time that passes in a pause": ("beta", "Beta 33", {"request": in_request("set_paused", put("paused", False))}),
    # Handshake and catalogue
    "the model's size": (ANY, "Session 3.2", {"reply": in_reply("hello_ok", each("mjb_size", lambda v: v + 1))}),
    "the model's text": ("beta", "Session 3.2", {"reply": in_reply("hello_ok", put("mjb_base64", "AAAA"))}),
    "the letters of the session id": (
        ANY,
        "Session 6",
        {"reply": in_reply("hello_ok", each("session_id", str.upper)), "request": each("session_id", str.lower)},
    ),
    "the version's number": ("beta", "Session 9.1", {"reply": in_reply("hello_ok", put("mujoco_version_int", 1.0))}),
    "an op that is gone": (
        "beta",
        "Beta 1",
        {"reply": in_reply("meta_ok", lambda r: r["ops"].append({**r["ops"][0], "name": "destroy_actor"}))},
    ),
    "an op that is not listed": (ANY, "Session 9.2", {"reply": in_reply("meta_ok", lambda r: r["ops"].pop() and None)}),
    "a required field that is not listed": (
        "beta",
        "Session 9.2",
        {"reply": in_reply("meta_ok", lambda r: [op.pop("required_fields", None) for op in r["ops"]] and None)},
    ),
    "an instance without capabilities": ("beta", "Beta 3", {"reply": instance(drop("capabilities"))}),
    "a prefix that is not the actor id": ("beta", "Beta 5", {"reply": robots(put("actor_id", "somebody else"))}),
    "a slash in a camera's topic": (
        "beta",
        "Beta 47",
        {"reply": robots(lambda r: [one.update(zmq_topic="a/camera/b") for one in r["camera_topics"].values()])},
    ),
    "actuators that the model lacks": (ANY, "Session 7", {"reply": robots(put("actuator_types", {"wing": "motor"}))}),
    "a keyframe that is not listed": (
        ANY,
        "Session 9.15",
        {"reply": in_reply("list_keyframes_ok", put("keyframes", []))},
    ),
    # Refusals
    "the code of an unknown op": (
        ANY,
        "Session 5.2",
        {"reply": in_reply("error:unknown_op", put("code", "bad_request"))},
    ),
    "a refusal without a message": (ANY, "Session 5.1", {"reply": in_reply("error:missing_op", drop("message"))}),
    "a field that may be missing": (
        ANY,
        "Session 5.2",
        {"reply": lambda request, reply: put("code", "busy")(reply) if request.get("op") == "set_paused" else None},
    ),
    "an old session that goes on": (
        "beta",
        "Session 6",
        {"reply": in_reply("error:session_expired", put("code", "busy"))},
    ),
    "a code that nobody knows": ("beta", "Session 9.6", {"reply": in_reply("error:bad_mode", put("code", "no_mood"))}),
    "contacts of bodies that the model lacks": (
        ANY,
        "Simulation 7.3",
        {"reply": in_reply("get_contacts_ok", touched)},
    ),
    # Modes and options
    "the mode before": (ANY, "Session 9.6", {"reply": in_reply("set_mode_ok", put("previous_mode", "puppet"))}),
    "a speed without limits": (ANY, "Session 9.8", {"reply": in_reply("set_sim_speed_ok", put("percent", 1000.0))}),
    "a time step that is ignored": (
        "beta",
        "Simulation 1.4",
        {"request": in_request("set_sim_options", lambda r: r["options"].pop("timestep", None))},
    ),
    "an integrator by another name": (
        "beta",
        "Beta 64",
        {"reply": in_reply("set_sim_options_ok", lambda r: r["options"].update(integrator="rk4"))},
    ),
    # Claims and leases
    "a claim that is not enforced": ("beta", "Beta 9", {"reply": unguarded}),
    "a claim that set-points by name get around": ("beta", "Beta 9", {"reply": partial(unguarded, only="ctrl_map")}),
    "a claim that wrenches get around": ("beta", "Beta 9", {"reply": partial(unguarded, only="xfrc_applied")}),
    "an owner that is not told": ("beta", "Beta 9", {"reply": in_reply("error:not_control_owner", drop("owner"))}),
    "a claim under the public name": (
        "beta",
        "Beta 12",
        {"reply": in_reply("claim_control_ok", put("articulation", "arm_a"))},
    ),
    "a time limit that is forgotten": ("beta", "Beta 15", {"reply": in_reply("claim_control_ok", put("ttl_s", 0.0))}),
    "a claim that never expires": ("beta", "Beta 16", {"request": in_request("claim_control", put("ttl_s", 0.0))}),
    "a lease that shows nowhere": ("beta", "Beta 27", {"reply": instance(put("busy", False))}),
    "a lease that never ends": (
        "beta",
        "Beta 29",
        {
            "request": in_request("acquire_lease", each("ttl_s", lambda _: 60.0)),
            "reply": in_reply("acquire_lease_ok", put("ttl_s", 0.5)),
        },
    ),
    "a control source that another client cannot hold": (
        "beta",
        "Beta 21",
        {"request": in_request("set_control_source", put("control_owner", "other"))},
    ),
    "a choice of the mode that ends the pause": (
        "beta",
        "Beta 95",
        {"reply": in_reply("forward_ok", each("time", lambda v: v + 0.002))},
    ),
    "a lease of another length": ("beta", "Beta 26", {"reply": in_reply("acquire_lease_ok", put("ttl_s", 30.0))}),
    # Streams
    "a snapshot's topic": ("beta", "Beta 43", {"message": in_topic(b"state/full", b"state/fool")}),
    "snapshots that go back in time": (
        "beta",
        "Beta 43",
        {"message": in_snapshot(each("time", lambda v: -v))},
    ),
    "a snapshot without sensors": (
        ANY,
        "Transports 3.3",
        {"message": in_snapshot(lambda s: [one.pop("sensors") for one in s["per_articulation"].values()])},
    ),
    "a space behind a topic": (ANY, "Transports 3.1", {"message": in_topic(b"/joint/j", b"/joint/j ")}),
    "a row's quaternion": (ANY, "Transports 3.2", {"message": in_row(b"base_state", swapped)}),
    "a row's length": (ANY, "Transports 3.2", {"message": in_row(b"/joint/", lambda payload: payload[:-4])}),
    # The editor
    "a place in centimetres": (
        ANY,
        "Editor 3.1 spawn_actor",
        {"request": in_request("spawn_actor", each("location", lambda v: [100 * x for x in v]))},
    ),
    "y turned over": (
        "beta",
        "Editor 3.1 duplicate_actor",
        {"request": in_request("duplicate_actor", each("location", lambda v: [-v[0], *v[1:]]))},
    ),
    "a move that is ignored": (
        ANY,
        "Editor 3.1 set_actor_transform",
        {"request": in_request("set_actor_transform", drop("location"))},
    ),
    "a job's result in a new session": ("beta", "Generation 2 8", {"reply": imported(put("code", "busy"))}),
    "a missing file's code": ("beta", "Generation 2 5", {"reply": imported(put("code", "bad_request"))}),
    "a quick op as a job": ("beta", "Generation 2 9", {"reply": in_reply("snapshot_ok", put("op", "op_started"))}),
    "entities without play": (
        "beta",
        "Beta 2",
        {"reply": in_reply("hello_ok", lambda r: r.setdefault("entities", {}))},
    ),
    "frame ids that go on": ("beta", "Generation 2 22", {"reply": in_reply("step_ok", put("frame_id", 7.0))}),
    "a document that is asked for again": (
        "beta",
        "Beta 59",
        {"reply": in_reply("upload_model_manifest_ok", put("need_xml", True))},
    ),
    "wrong bytes that are taken": ("beta", "Beta 60", {"reply": in_reply("error:hash_mismatch", put("code", "busy"))}),
    "an unknown upload's code": ("beta", "Beta 61", {"reply": in_reply("error:unknown_upload", put("code", "busy"))}),
    "an upload that leads nowhere": ("beta", "Beta 62", {"reply": in_reply("upload_model_commit_ok", put("nq", 7.0))}),
    "a job's number": ("beta", "Generation 2 2", {"reply": SameJob()}),
    "a job that ends with its session": ("beta", "Generation 2 8", {"reply": EndedJobs()}),
    "a rotation that is not one": (
        ANY,
        "Editor 2.2",
        {
            "reply": in_reply(
                "list_actors_ok", lambda r: [one.update(rotation_quat=[1.0] * 4) for one in r["actors"]] and None
            )
        },
    ),
    # The level and its actors
    "no level that is open": (
        ANY,
        "Editor 3.1 current_level",
        {"reply": in_reply("current_level_ok", drop("level_path"))},
    ),
    "a second manager": (
        ANY,
        "Editor 3.1 ensure_manager",
        {"reply": in_reply("ensure_manager_ok", put("was_existing", False))},
    ),
    "the number of cells": (ANY, "Editor 3.1 spawn_grid", {"reply": in_reply("spawn_grid_ok", put("count", 3.0))}),
    "the ids of cells": (
        ANY,
        "Editor 3.1 spawn_grid",
        {"request": in_request("spawn_grid", put("base_actor_id", "cel"))},
    ),
    "the places of cells": (
        ANY,
        "Editor 3.1 spawn_grid",
        {"request": in_request("spawn_grid", put("spacing", [1.0, 1.0, 0.0]))},
    ),
    "an actor that stays": (
        ANY,
        "Editor 3.1 destroy_actor",
        {"request": in_request("destroy_actor", put("target", "nobody")), "reply": kept_actor},
    ),
    "the middle of bounds": (
        ANY,
        "Editor 3.3 get_actor_bounds",
        {"reply": in_reply("get_actor_bounds_ok", each("center", lambda v: [v[0], v[1], v[2] + 1.0]))},
    ),
    "bounds of another actor": (
        ANY,
        "Editor 3.3 get_actor_bounds",
        {
            "reply": in_reply(
                "get_actor_bounds_ok",
                lambda r: r.update({name: [r[name][0] + 50.0, *r[name][1:]] for name in ("min", "max", "center")}),
            )
        },
    ),
    "what a saved level has": (
        ANY,
        "Editor 3.1 save_level",
        {"request": in_request("spawn_actor", put("location", [2.0, 0.0, 0.0]))},
    ),
    "an asset that was there": (
        ANY,
        "Editor 3.1 destroy_asset",
        {"reply": in_reply("destroy_asset_ok", put("was_found", True))},
    ),
    "other robots as play begins": (
        ANY,
        "Editor 3.2 begin_pie",
        {
            "reply": in_reply(
                "begin_pie_ok", lambda r: r["handshake_payload"]["articulations"][0].update(actor_id="x") and None
            )
        },
    ),
    "play that begins unpaused": (
        ANY,
        "Editor 3.2 begin_pie",
        {"reply": in_reply("step_ok", passing)},
    ),
    "a state of play": (ANY, "Editor 3.2 pie_status", {"reply": in_reply("pie_status_ok", put("state", "resting"))}),
    "play that is off": (ANY, "Editor 3.2 pie_status", {"reply": in_reply("pie_status_ok", put("state", "off"))}),
    # Modes, channels and streams
    "a reply without entities": (ANY, "Session 8.3", {"reply": in_reply("step_ok", drop("entities"))}),
    "a reply without the time of day": (ANY, "Session 8.3", {"reply": in_reply("step_ok", drop("wall_time"))}),
    "a live set-point that is ignored": (
        "beta",
        "Beta 34",
        {"reply": in_state(each("ctrl", lambda v: [0.0 for _ in v]))},
    ),
    "time that passes while it is paused": (
        ANY,
        "Beta 88",
        {"reply": in_reply("forward_ok", each("time", lambda v: v + 1.0))},
    ),
    "a step of two robots of which one is nobody's": ("beta", "Beta 17", {"reply": unguarded}),
    "another owner": ("beta", "Beta 14", {"reply": in_reply("error:control_claimed", put("owner", "nobody"))}),
    "commands to another's robot": ("beta", "Beta 14", {"reply": unguarded}),
    "a channel that nobody declared": (
        "beta",
        "Beta 46",
        {"reply": in_reply("set_user_channels_ok", put("applied", 1.0))},
    ),
    "no word of the channel": ("beta", "Beta 46", {"reply": in_reply("set_user_channels_ok", put("rejected", []))}),
    "messages in direct mode": ("beta", "Beta 44", {"request": in_request("set_mode", put("mode", "live"))}),
    "the topic of a step's snapshot": (ANY, "Transports 3.4", {"message": in_topic(b"state/full", b"state/part")}),
    "a snapshot of another time": (ANY, "Transports 3.4", {"message": in_snapshot(each("time", lambda v: v + 99.0))}),
    "a field that nobody knows": (ANY, "Beta 8", {"reply": unknown_fields}),
    "the cameras of the scene": ("beta", "Beta 87", {"reply": in_reply("hello_ok", drop("global_cameras"))}),
    "a camera's announced topic": (
        ANY,
        "Session 9.1.1",
        {"reply": robots(lambda one: [it.update(zmq_topic="x") for it in one["camera_topics"].values()])},
    ),
    "a camera's angle": (
        ANY,
        "Session 9.1.1",
        {"reply": robots(lambda one: [it.update(fovy=200.0) for it in one["camera_topics"].values()])},
    ),
}
FALSIFIED |= {
    f"{op} is refused, for another reason than {code} {fields or ''}": (
        generation,
        statement,
        {"reply": refusal(op, code, **fields)},
    )
    for generation, statement, op, code, fields in (
        (ANY, "Editor 3.1 create_level", "create_level", "create_level_failed", {}),
        (ANY, "Editor 3.1 create_level", "create_level", "missing_field", {}),
        (ANY, "Editor 3.1 import_xml", "import_xml", "import_failed", {}),
        (ANY, "Editor 3.1 import_xml", "import_xml", "missing_field", {"path": None}),
        (ANY, "Editor 3.1 import_xml", "import_xml", "missing_field", {"path": ""}),
        (ANY, "Editor 3.1 destroy_actor", "destroy_actor", "destroy_failed", {}),
        (ANY, "Editor 3.1 load_level", "load_level", "load_level_failed", {}),
        ("beta", "Beta 4", "step", "not_control_owner", {}),
        (ANY, "Beta 88", "step", "step_timeout", {}),
        (ANY, "Session 9.9", "set_control_source", "bad_value", {}),
        (ANY, "Session 9.9", "set_control_source", "missing_field", {}),
        (ANY, "Session 9.10", "set_twist", "unknown_articulation", {}),
        (ANY, "Session 9.10", "set_qpos", "unknown_articulation", {}),
        (ANY, "Session 9.10", "set_qpos", "dim_mismatch", {}),
        (ANY, "Session 9.12", "set_mocap_pose", "unknown_body", {}),
        (ANY, "Session 9.12", "read_mocap_pose", "unknown_body", {}),
        ("beta", "Beta 19", "release_control", "not_control_owner", {}),
        ("beta", "Beta 19", "release_control", "unknown_articulation", {}),
        ("beta", "Beta 19", "release_control", "missing_field", {}),
        ("beta", "Beta 19", "set_qpos", "not_control_owner", {}),
        ("beta", "Beta 19", "set_twist", "not_control_owner", {}),
        ("beta", "Beta 19", "set_twist", "unknown_articulation", {}),
        ("beta", "Generation 2 7", "op_status", "missing_field", {}),
        ("beta", "Generation 2 7", "op_status", "bad_request", {}),
        ("beta", "Generation 2 7", "op_status", "unknown_job", {"job_id": "job_999999"}),
        ("beta", "Generation 2 7", "op_status", "session_expired", {}),
    )
}
FALSIFIED |= {
    f"{op} fails": (generation, statement, {"reply": failing(op)})
    for generation, statement, op in (
        (ANY, "Editor 3.1 snapshot", "snapshot"),
        (ANY, "Editor 3.1 snapshot", "actor_hierarchy"),
        (ANY, "Editor 3.1 snapshot", "list_blueprints"),
        (ANY, "Editor 3.1 snapshot", "get_camera"),
        ("beta", "Beta 22", "forward"),
        ("beta", "Beta 21", "set_control_source"),
    )
}

PICTURES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "a long delay that is ignored": (
        "beta",
        "Beta 94",
        {"request": in_request("set_camera_delay", each("cameras", lambda v: dict.fromkeys(v, 0.0)))},
    ),
    "a switch that is always wide": (
        "beta",
        "Generation 2 36",
        {
            "request": in_request(
                "set_camera_streaming", each("cameras", lambda v: {k: bool(one) for k, one in v.items()})
            )
        },
    ),
    "a bare name that means a camera": (
        "beta",
        "Beta 48",
        {"reply": in_reply("step_ok", lambda r: r.update(cameras=r.get("cameras") or {}))},
    ),
    "a live step without a picture": ("beta", "Beta 49", {"reply": InLive(drop("cameras"))}),
    "a picture that is not drawn yet": (
        "beta",
        "Beta 52",
        {"request": in_request("step", each("include_cameras", any_picture))},
    ),
    "a picture that can be had once": ("beta", "Generation 2 26", {"reply": earlier_cameras}),
    "a camera that publishes while it is paused": (
        "beta",
        "Beta 55",
        {"request": in_request("set_paused", put("paused", False))},
    ),
    "a delay that is not told": (
        "beta",
        "Beta 54",
        {
            "reply": in_reply(
                "set_camera_delay_ok", lambda r: [one.update(delay_s=0.0) for one in r["cameras"].values()] and None
            )
        },
    ),
    "a delay without its clock": (
        "beta",
        "Beta 54",
        {
            "reply": in_reply(
                "set_camera_delay_ok", lambda r: [one.pop("clock") for one in r["cameras"].values()] and None
            )
        },
    ),
    "a delay that is no delay": (
        "beta",
        "Beta 54",
        {
            "request": in_request("set_camera_delay", each("cameras", lambda v: dict.fromkeys(v, 0.0))),
            "reply": in_reply(
                "set_camera_delay_ok", lambda r: [one.update(delay_s=0.1) for one in r["cameras"].values()] and None
            ),
        },
    ),
    "a stale picture": ("beta", "Beta 50", {"reply": pictures(each("frame_id", lambda v: v - 1))}),
    "a picture of another time": ("beta", "Beta 50", {"reply": pictures(each("sim_time", lambda v: v + 0.002))}),
    "a picture's size": (ANY, "Session 8.4", {"reply": pictures(put("width", 32.0))}),
    "a picture's end": (ANY, "Session 8.4", {"reply": pictures(each("data", lambda v: v[:-4]))}),
    "a picture under another name": (
        ANY,
        "Session 8.4",
        {"reply": in_reply("step_ok", each("cameras", lambda v: {f"{name} 2": one for name, one in v.items()}))},
    ),
    "a camera's topic": ("beta", "Beta 56", {"message": in_topic(b"cam ", b"cam")}),
    "a camera's topic in the alpha": (ANY, "Transports 5.2", {"message": in_topic(b"cam ", b"cam2 ")}),
    "the number of a streamed picture": ("beta", "Beta 56", {"message": in_header(8, "<Q", 7)}),
    "the time of a streamed picture": ("beta", "Beta 56", {"message": in_header(16, "<d", 99.0)}),
    "a switch that stays on": (
        "beta",
        "Beta 53",
        {
            "reply": in_reply(
                "set_camera_streaming_ok",
                lambda r: [one.update(streaming=True) for one in r["cameras"].values()] and None,
            )
        },
    ),
}


WITH_REPLIES = ("Session 10.2", "Editor 3.3 list_actors", "Editor 3.1 current_level")
"""Statements whose checks give the check of every reply something to judge."""


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, tuple[SimulatedServer, Path]]]:
    """Servers of both generations with a saved level in play."""
    made: dict[str, tuple[SimulatedServer, Path]] = {}
    folders = {name: tmp_path_factory.mktemp(name) for name in ("alpha", "beta")}

    async def prepare(served: SimulatedServer, folder: Path) -> None:
        async with bench(served, folder) as ready:
            await furnish(ready, folder)

    with server(folders["alpha"], "alpha", shm=False) as alpha, server(folders["beta"], "beta", shm=False) as beta:
        for name, served in (("alpha", alpha), ("beta", beta)):
            asyncio.run(prepare(served, folders[name]))
            made[name] = served, folders[name]
        yield made


async def verdicts(target: tuple[SimulatedServer, Path], statement: str, **how: Any) -> dict[str, Verdict]:
    """Return the verdicts on all statements when something is falsified and one of them is checked."""
    served, folder = target
    with Falsifier(served, **how) as relay:
        async with bench(served, folder, port=relay.port, state_port=relay.state_port) as made:
            named = (statement, *(WITH_REPLIES if statement in {"Fields 1", "Session 3.1"} else ()))
            choice = Choice(frozenset(Group), statements=named, measure=False)
            report = await run(made, choice)
    return {row.id: row.verdict for row in report.statements}


async def differing(target: tuple[SimulatedServer, Path], statement: str, **how: Any) -> set[str]:
    """Return the statements that differ when something is falsified."""
    return {name for name, verdict in (await verdicts(target, statement, **how)).items() if verdict is Verdict.DIFFERS}


@pytest.mark.parametrize("what", FALSIFIED)
async def test_what_is_falsified_is_named(targets: dict[str, tuple[SimulatedServer, Path]], what: str) -> None:
    generation, statement, how = FALSIFIED[what]
    assert statement in await differing(targets[generation], statement, **how)


@pytest.mark.opengl
@pytest.mark.parametrize("what", PICTURES)
async def test_a_falsified_picture_is_named(targets: dict[str, tuple[SimulatedServer, Path]], what: str) -> None:
    generation, statement, how = PICTURES[what]
    assert statement in await differing(targets[generation], statement, **how)


@pytest.mark.parametrize("generation", ["alpha", "beta"])
async def test_the_relay_falsifies_nothing_by_itself(
    targets: dict[str, tuple[SimulatedServer, Path]], generation: str
) -> None:
    for statement in ("Session 10.2", "Beta 43", "Transports 3.2", "Session 9.1"):
        assert await differing(targets[generation], statement) == set()


@pytest.mark.parametrize(("width", "verdict"), [(1, Verdict.HOLDS), (3, Verdict.HOLDS), (0, Verdict.DIFFERS)])
async def test_before_the_beta_frame_ids_need_only_grow(
    targets: dict[str, tuple[SimulatedServer, Path]], width: int, verdict: Verdict
) -> None:
    """The generation between the alpha and the beta has both the ids and the switch of cameras."""
    ids = itertools.count(1, width) if width else itertools.repeat(1)

    def june(_request: Fields, reply: Fields) -> None:
        if reply.get("op") == "meta_ok":
            reply["ops"].append({**reply["ops"][0], "name": "set_camera_streaming"})
        elif reply.get("op") == "step_ok":
            reply["frame_id"] = float(next(ids))

    assert (await verdicts(targets["alpha"], "Generation 2 19", reply=june))["Generation 2 19"] is verdict
