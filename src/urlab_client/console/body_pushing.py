"""Bodies in the 3-D view: listing them, picking one with a ray, and pushing one with the mouse.

A push is a spring between a point of the body and the pointer. In direct mode it is a force in every step that the
console makes; in puppet mode the robot is moved. A browser renews its push while the button is held, so the push ends
if the browser disappears.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from urlab_client.console.lease import DrivingLease, Viewer
from urlab_client.console.mujoco_viewer import MujocoViewer, Shown, no_model
from urlab_client.console.pictures import Cameras
from urlab_client.console.replay import Replay
from urlab_client.console.shared_view import SharedView
from urlab_client.enums import StepMode
from urlab_client.values.names import split_prefix

if TYPE_CHECKING:
    from urlab_client.aio import URLabArticulation, URLabClient

_POSED_S = 0.25  # as much time passes at most
_HELD_S = 0.6
_VISIBLE_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)

Vector = Annotated[list[float], Meta(min_length=3, max_length=3)]


class BodyView(Struct):
    """A body: its number in the model, mass in kg, position of its frame in metres, world axes."""

    id: int
    name: str
    robot: str
    mass: float
    position: list[float]


class BodyList(Struct):
    """The bodies, and a sphere around those of robots: `center` and `radius` in metres."""

    bodies: list[BodyView]
    center: list[float]
    radius: float


class Pick(Struct, forbid_unknown_fields=True):
    """A ray, metres in the world frame."""

    origin: Vector
    direction: Vector


class Picked(Struct):
    """The first hit of a ray: the body, None for nothing or the ground, and the point in the body's and world frame."""

    body: BodyView | None
    local: list[float]
    point: list[float]


class Push(Struct, forbid_unknown_fields=True):
    """Pull a point of a body, given in its frame, towards a place in the world; metres."""

    body: int
    local: Vector
    target: Vector


class Posing:
    """Places robots in puppet mode.

    Time passes as on the wall while viewers pose, so that curves and recordings show the motion.
    """

    def __init__(self, client: URLabClient, lease: DrivingLease, view: SharedView, cameras: Cameras) -> None:
        self._client = client
        self._lease = lease
        self._view = view
        self._cameras = cameras
        self._at = 0.0

    async def place(self, viewer: Viewer, values: Mapping[str, Mapping[str, float]]) -> None:
        """Place joints of one coordinate, by articulation and joint, or none if one cannot be."""
        if self._client.step_mode is not StepMode.PUPPET:
            raise ValueError(f"posing needs puppet mode, not {self._client.step_mode}, in which physics moves joints")
        if (data := self._client.data) is None:
            raise ValueError("posing needs a local model, and none could be compiled")
        robots = self._client.articulations
        joints = [(robots[key].joints[name], value) for key, given in values.items() for name, value in given.items()]
        for joint, value in joints:
            if joint.kind not in ("hinge", "slide"):
                raise ValueError(f"{joint.name} is a {joint.kind} joint: only hinge and slide joints take one number")
            low, high = joint.limits or (-math.inf, math.inf)
            if not low <= value <= high:
                raise ValueError(f"{joint.name} goes from {low:g} to {high:g} {joint.unit}: {value:g} is out of reach")
        self._lease.use(viewer)
        for joint, value in joints:
            data.qpos[joint.qpos_offset] = value
        for key, given in values.items():
            self._view.note_burst(viewer.name, "pose", key, given)
        await self.push()

    async def push(self) -> None:
        """Send the pose of the local data, with the pictures that are watched, which come with replies alone."""
        now, data = time.monotonic(), self._client.data
        if data is not None:
            data.time += min(max(now - self._at, self._view.world.timestep or _POSED_S), _POSED_S)
        self._at = now
        await self._client.step(0, include_cameras=dict.fromkeys(self._cameras.watched(), "sync") or False)


class BodyPushing:
    """The bodies of one console, and at most one push at a time."""

    def __init__(
        self,
        client: URLabClient,
        lease: DrivingLease,
        viewer: MujocoViewer,
        replay: Replay,
        posing: Posing,
    ) -> None:
        self._client = client
        self._lease = lease
        self._viewer = viewer
        self._replay = replay
        self._posing = posing
        self._push: Push | None = None
        self._by: Viewer | None = None
        self._until = 0.0

    async def bodies(self) -> BodyList:
        """Return the bodies and where they are."""
        shown = await self._now()
        return BodyList([_view(shown, body) for body in range(1, shown.model.nbody)], *_sphere(shown))

    async def body(self, body: int) -> BodyView:
        """Return one body."""
        shown = await self._now()
        return _view(shown, _checked(shown, body))

    async def pick(self, ray: Pick) -> Picked:
        """Return the first hit of a ray."""
        import mujoco

        shown = await self._now()
        origin, direction = np.array(ray.origin, np.float64), np.array(ray.direction, np.float64)
        length = float(np.linalg.norm(direction))
        if not 0.0 < length < np.inf:
            raise ValueError("a ray needs a direction other than zero, of finite length")
        direction /= length
        geom = np.full(1, -1, np.int32)
        far = mujoco.mj_ray(shown.model, shown.data, origin, direction, _VISIBLE_GROUPS, 1, -1, geom)
        body = int(shown.model.geom_bodyid[geom[0]]) if geom[0] >= 0 else 0
        if body == 0:
            return Picked(None, [0.0] * 3, [0.0] * 3)
        point = origin + far * direction
        local = shown.data.xmat[body].reshape(3, 3).T @ (point - shown.data.xpos[body])
        return Picked(_view(shown, body), local.tolist(), point.tolist())

    async def push(self, viewer: Viewer, push: Push) -> None:
        """Start or renew a push."""
        shown = await self._now()
        robot = self._robot(shown, _checked(shown, push.body))
        if self._replay.open:
            raise ValueError("A replay is shown. Go back to live to push.")
        mode = self._client.step_mode
        if mode is StepMode.LIVE:
            raise ValueError(
                "In live mode a force lasts one physics step at most. To push, choose direct mode and Play, or puppet."
            )
        self._lease.use(viewer)
        if mode is StepMode.PUPPET:
            await self._place(shown, push, robot)
            return
        self._push, self._by, self._until = push, viewer, time.monotonic() + _HELD_S

    def release(self, viewer: Viewer) -> None:
        """End this viewer's push."""
        if self._by is not None and self._by.key == viewer.key:
            self._push = self._by = None

    def apply(self) -> None:
        """Add the force of the push to the next step of direct mode."""
        import mujoco

        if self._push is None or time.monotonic() > self._until or (shown := self._viewer.latest()) is None:
            self._push = self._by = None
            return
        push, model, data = self._push, shown.model, shown.data
        if push.body >= model.nbody:  # play began again, with another model
            return
        perturb = mujoco.MjvPerturb()
        perturb.select, perturb.active = push.body, int(mujoco.mjtPertBit.mjPERT_TRANSLATE)
        perturb.localpos[:], perturb.refselpos[:] = push.local, push.target
        perturb.localmass = float(model.body_subtreemass[_root(model, push.body)])
        mujoco.mj_comVel(model, data)
        mujoco.mjv_applyPerturbForce(model, data, perturb)
        wrench = data.xfrc_applied[push.body].copy()
        data.xfrc_applied[push.body] = 0.0
        robot = self._robot(shown, push.body)
        name = next(one.name for one in robot.bodies.values() if one.id == push.body)
        robot.apply_xfrc(name, force=wrench[:3].tolist(), torque=wrench[3:].tolist())

    async def _now(self) -> Shown:
        if await self._viewer.shown() is None or (shown := self._viewer.latest()) is None:
            raise ValueError(no_model(self._client) or "No state has arrived yet.")
        return shown

    def _robot(self, shown: Shown, body: int) -> URLabArticulation:
        """Return whose body it is."""
        key, name = _named(shown, body)
        robot = self._client.articulations.get(key)
        if robot is None:
            raise ValueError(f"{name} does not belong to a robot. Only bodies of robots can be pushed.")
        return robot

    async def _place(self, shown: Shown, push: Push, robot: URLabArticulation) -> None:
        """Move the robot so that the point is where the pointer is."""
        model, data = shown.model, self._client.data
        joint = int(model.body_jntadr[_root(model, push.body)])
        free = joint >= 0 and int(model.jnt_type[joint]) == 0
        if not free or data is None:
            raise ValueError(f"{robot.prefix} is fixed to the world: in puppet mode its joints move it, not the mouse.")
        at = int(model.jnt_qposadr[joint])
        point = shown.data.xpos[push.body] + shown.data.xmat[push.body].reshape(3, 3) @ np.array(push.local)
        data.qpos[at : at + 3] = shown.data.qpos[at : at + 3] + np.array(push.target) - point
        await self._posing.push()


def _checked(shown: Shown, body: int) -> int:
    if not 0 < body < shown.model.nbody:
        raise ValueError(f"there is no body {body}: they are numbered from 1 to {shown.model.nbody - 1}")
    return body


def _root(model: Any, body: int) -> int:
    """Return the body nearest to the world, of those that move and carry this one; itself if none moves."""
    found = one = body
    while one > 0:
        if model.body_dofnum[one]:
            found = one
        one = int(model.body_parentid[one])
    return found


def _named(shown: Shown, body: int) -> tuple[str, str]:
    """Return whose body it is, and what that robot calls it; an empty key for none."""
    keys = {prefix: key for key, prefix in shown.prefixes.items()}
    [(owner, name)] = split_prefix([shown.model.body(body).name], keys)
    return ("", name or f"body {body}") if owner is None else (keys[owner], name)


def _view(shown: Shown, body: int) -> BodyView:
    robot, name = _named(shown, body)
    mass = float(shown.model.body_mass[body])
    return BodyView(body, name, robot, round(mass, 4), _rounded(shown.data.xpos[body]))


def _sphere(shown: Shown) -> tuple[list[float], float]:
    """Return a sphere around all robots, or around all bodies where there is none."""
    model, data = shown.model, shown.data
    owned = np.array([bool(_named(shown, body)[0]) for body in range(model.nbody)])
    if not owned.any():
        owned[1:] = True  # all but the world
    geoms = owned[model.geom_bodyid] & (model.geom_rbound > 0.0)
    if not geoms.any():
        return [0.0, 0.0, 0.0], 1.0
    places, sizes = data.geom_xpos[geoms], model.geom_rbound[geoms, None]
    low, high = (places - sizes).min(axis=0), (places + sizes).max(axis=0)
    return _rounded((low + high) / 2.0), round(float(np.linalg.norm(high - low)) / 2.0, 4)


def _rounded(values: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 4) for value in values]
