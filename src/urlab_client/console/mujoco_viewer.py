"""The 3-D view: MuJoCo's own web viewer, fed with the state that all viewers see and served under the console's access.

MuJoCo ships the page, which draws a compiled model with WebGL. Its server is not used, because it listens on its own
port and admits everyone. Here a page only watches: it gets the model and the newest state.
"""

from __future__ import annotations

import base64
import hashlib
import re
import struct
import zlib
from collections.abc import Mapping
from functools import cache
from html import unescape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import anyio.to_thread
import msgspec
import numpy as np

from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.model.layout import ArticulationLayout, articulation_layouts
from urlab_client.protocol.messages.streams import StateSnapshot

if TYPE_CHECKING:
    import mujoco

    from urlab_client.aio import URLabClient
    from urlab_client.console.shared_view import SharedView

SPECTATOR = "viewers=1;role=spectator;queue_pos=0;queue_len=0;max_spectators=0"
"""Tells a page that it watches."""

LAYOUT = "layout="
"""Begins what tells a page where values lie in a state."""

SHOWN = "state_ack"
"""What a page says when it has taken a state over."""

TAKEN = 4001
"""Close code that tells a page that somebody else has MuJoCo's own panels."""

_SHIM = '<script src="../static/viewer_pointer.js"></script><script src="../static/mujoco_viewer.js"></script>'
_INLINE = re.compile(r"<script>(.*?)</script>", re.DOTALL)
_HANDLERS = re.compile(r"""\son[a-z]+="([^"]*)\"""")


class Files(NamedTuple):
    """What the MuJoCo package ships for browsers: `page` with our adapter in it, and where the rest lies.

    `policy` is the content security policy that the page needs: it compiles WebAssembly and the calls into it.
    """

    page: str
    policy: str
    dist: Path
    assets: Path


@cache
def files() -> Files | None:
    """Return the shipped files, or None if this MuJoCo has no web viewer."""
    payload = _payload()
    if payload is None:
        return None
    root = Path(str(import_module("mujoco.studio").__file__)).parent
    dist = root / "web" / "dist"
    page = dist / "index.html"
    if not page.is_file():
        return None
    html = page.read_text("utf-8")
    inline = [*_INLINE.findall(html), *(unescape(handler) for handler in _HANDLERS.findall(html))]
    hashes = " ".join(["'unsafe-hashes'", *(f"'sha256-{_digest(script)}'" for script in inline)])  # also of handlers
    policy = (
        f"default-src 'self'; script-src 'self' 'unsafe-eval' {hashes}; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' blob: data:; frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
    )
    return Files(html.replace("<head>", f"<head>{_SHIM}", 1), policy, dist, root / "assets")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()


@cache
def _payload() -> Any:
    """Return MuJoCo's module that writes what its page reads, or None."""
    try:
        return import_module("mujoco.studio.web.state_payload")
    except ImportError:
        return None


class Shown(NamedTuple):
    """A model as the page gets it: `bundle` with the number `crc` that tells it from others, and where values go.

    Without MuJoCo's web viewer there is no page, and `bundle` and `layout` are empty.
    `prefixes` are those of the robots' compiled names. `layout` tells a page where in a state the camera, the selection
    and the overlays lie, so that each page can have its own.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    bundle: bytes
    crc: int
    robots: Mapping[str, ArticulationLayout]
    camera: Any
    flags: list[int]
    prefixes: Mapping[str, str]
    layout: str


def no_view(client: URLabClient) -> str:
    """Return why there is no 3-D view; empty if there is one."""
    if files() is None:
        import mujoco

        return f"MuJoCo {mujoco.__version__} has no web viewer here. Wheels for Linux and macOS have one since 4.0."
    return no_model(client)


def no_model(client: URLabClient) -> str:
    """Return why there is no model to show; empty if there is one."""
    if client.model is not None:
        return ""
    if not client.manager_present:
        return "Waiting for a play session: begin play to see the robots."
    return "The 3-D view needs a compiled model, and the console has none."


class MujocoViewer:
    """The model and the shown state for browsers; each state is written once, however many watch."""

    def __init__(self, client: URLabClient, view: SharedView) -> None:
        self._client = client
        self._view = view
        self._shown: Shown | None = None
        self._written: tuple[StateSnapshot, bytes] | None = None
        self._placed: StateSnapshot | None = None

    async def shown(self) -> Shown | None:
        """Return the client's model, made ready for browsers where MuJoCo has a viewer for them, or None."""
        model = self._client.model
        if model is None:
            return None
        if self._shown is None or self._shown.model is not model:
            prefixes = compiled_prefixes(self._client.articulations)
            self._shown = await anyio.to_thread.run_sync(_prepare, model, prefixes)
            self._written = self._placed = None
        return self._shown

    def latest(self) -> Shown | None:
        """Return the model with the newest state in its data and bodies placed; None without one of them."""
        import mujoco

        shown, snapshot = self._shown, self._view.snapshot
        if shown is None or snapshot is None or shown.model is not self._client.model:
            return None
        if self._placed is not snapshot:
            self._place(shown, snapshot)
            mujoco.mj_kinematics(shown.model, shown.data)
            mujoco.mj_comPos(shown.model, shown.data)
            self._placed = snapshot
        return shown

    def write(self, shown: Shown, snapshot: StateSnapshot) -> bytes:
        """Return a state as the page reads it."""
        if self._written is None or self._written[0] is not snapshot:
            import mujoco

            self._place(shown, snapshot)
            view = shown.camera, mujoco.MjvPerturb(), mujoco.MjvOption()
            self._written = snapshot, _serialize(shown.model, shown.data, view, shown.flags, shown.crc)
        return self._written[1]

    def _place(self, shown: Shown, snapshot: StateSnapshot) -> None:
        """Put a state into the data: positions, and velocities, which contact forces depend on."""
        model, data = shown.model, shown.data
        data.time = snapshot.time
        for key, state in snapshot.per_articulation.items():
            robot = shown.robots.get(key)
            if robot is not None and len(state.qpos) == len(robot.qpos_adr):
                data.qpos[robot.qpos_adr] = state.qpos
                if len(state.qvel) == len(robot.qvel_adr):
                    data.qvel[robot.qvel_adr] = state.qvel
        for name, pose in snapshot.entities.items():
            entity = self._client.entities.get(name)
            if entity is None:
                continue
            mocap = int(model.body_mocapid[entity.body_id])
            if mocap >= 0:
                data.mocap_pos[mocap], data.mocap_quat[mocap] = pose.xpos, pose.xquat
            elif pose.qpos is not None and entity.qpos_offset is not None:
                data.qpos[entity.qpos_offset : entity.qpos_offset + 7] = pose.qpos


def _prepare(model: mujoco.MjModel, prefixes: Mapping[str, str]) -> Shown:
    import mujoco

    viewed = files() is not None
    bundle: bytes = _payload().serialize_model_bundle(model) if viewed else b""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    robots = articulation_layouts(model, prefixes)
    flags = [int(flag) for flag in mujoco.MjvScene(model, maxgeom=1).flags]  # shadows, reflections, sky
    data, layout = mujoco.MjData(model), _layout(model) if viewed else ""
    return Shown(model, data, bundle, zlib.crc32(bundle), robots, camera, flags, prefixes, layout)


def _serialize(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    view: tuple[mujoco.MjvCamera, mujoco.MjvPerturb, mujoco.MjvOption],
    flags: list[int],
    crc: int = 0,
) -> bytes:
    import mujoco

    what = int(mujoco.mjtState.mjSTATE_INTEGRATION)
    state = np.empty(mujoco.mj_stateSize(model, what))
    mujoco.mj_getState(model, data, state, what)
    payload = _payload()
    return payload.serialize_state_payload(
        crc, what, state.tobytes(), *view, model, flags, [], payload.ViewerInputState()
    )


_MARK = 0x5A3C1E7B
_PLACE = (12345.678, 23456.789, 34567.891)
_MARKED: dict[str, tuple[int, str, Any]] = {
    "camera": (0, "lookat", _PLACE),
    "select": (1, "select", _MARK),
    "active": (1, "active", _MARK),
    "localpos": (1, "localpos", _PLACE),
    "refselpos": (1, "refselpos", _PLACE),
    "frame": (2, "frame", _MARK),
    "flags": (2, "flags", 0x5A),
}
"""What the page changes in a state: in its camera (0), perturbation (1) or options (2), and a value to find it by."""


def _layout(model: mujoco.MjModel) -> str:
    """Return as JSON where values lie in a state of this model, in bytes; what cannot be told is left out.

    MuJoCo does not document the format. It is found by writing values that occur nowhere else.
    """
    import mujoco

    data = mujoco.MjData(model)
    places: dict[str, Any] = {"fovy": float(model.vis.global_.fovy)}
    for name, (owner, attribute, value) in _MARKED.items():
        view = mujoco.MjvCamera(), mujoco.MjvPerturb(), mujoco.MjvOption()
        part = view[owner]
        field: Any = getattr(part, attribute)
        if isinstance(field, int):
            setattr(part, attribute, value)
            mark = struct.pack("<i", value)
        else:
            field[:] = value
            mark = bytes(field)
        written = _serialize(model, data, view, [0] * int(mujoco.mjtRndFlag.mjNRNDFLAG))
        if written.count(mark) == 1:
            places[name] = written.index(mark)
    if "flags" in places:
        shown = mujoco.mjtVisFlag
        places["contacts"] = [
            places["flags"] + int(one) for one in (shown.mjVIS_CONTACTPOINT, shown.mjVIS_CONTACTFORCE)
        ]
    return msgspec.json.encode(places).decode()
