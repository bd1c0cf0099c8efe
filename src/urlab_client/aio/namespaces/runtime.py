"""`client.runtime`: live changes to the running simulation."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from msgspec.structs import asdict, replace

from urlab_client.aio.state.scene_objects import SceneObjects
from urlab_client.protocol.base import Reply, Request
from urlab_client.protocol.messages.runtime import (
    GetContacts,
    GetContactsOk,
    MocapReply,
    ReadMocapPose,
    SetControlSource,
    SetMocapPose,
    SetTwist,
)

if TYPE_CHECKING:
    import mujoco

from functools import partial
from typing import cast

import msgspec
import numpy as np

from urlab_client.aio.arguments import finite, is_array, mapping, require, text
from urlab_client.aio.articulation import compiled_prefixes
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.model.layout import compiled_ids
from urlab_client.aio.namespaces._base import Vector, fill, target_by
from urlab_client.aio.namespaces._ops import RuntimeOps
from urlab_client.aio.session.jobs import OnProgress
from urlab_client.aio.session.session import Session
from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.sim_state import SimState
from urlab_client.enums import StepMode, StepModeName
from urlab_client.errors import UnknownOp
from urlab_client.protocol.base import Floats
from urlab_client.protocol.codec import building
from urlab_client.protocol.messages.cameras import (
    CameraDelay,
    CameraDelayInForce,
    CameraStreaming,
    CameraTransports,
    SetCameraDelay,
)
from urlab_client.protocol.messages.runtime import (
    ContactFilter,
    SetMode,
    SetPaused,
    SetQpos,
    SetSimOptions,
    SetSimSpeed,
    SetUserChannels,
)
from urlab_client.protocol.messages.session import Forward, ForwardOk
from urlab_client.protocol.sim_options import check_sim_options, in_small_letters
from urlab_client.values.types import ContactsResult, SimOptions

log: logging.Logger = logging.getLogger("urlab_client.client")

R = TypeVar("R", bound=Reply)
Q = TypeVar("Q", bound=Request[Any])

_NUMPY = (np.ndarray, np.generic)


class RuntimeNamespace(RuntimeOps):
    """Live changes to the running simulation; every op needs a play session."""

    def __init__(self, session: Session, state: SimState) -> None:
        super().__init__(session)
        self._state = state

    async def _call(self, request: Request[R], timeout: Timeout, on_progress: OnProgress | None = None) -> R:
        sent = for_the_server(request, self._state.objects, self._state.mirror.model)
        return as_written(await super()._call(sent, timeout, on_progress), request)

    async def set_paused(self, paused: bool, *, timeout: Timeout = DEFAULT) -> bool:
        """Pause or resume physics, and return the state in force.

        Args:
            paused: True to pause.
            timeout: Seconds to wait; None waits without limit.
        """
        async with self._session.turn(SetPaused, timeout=timeout) as turn:
            await self._pause(paused, turn)
            return self._state.mode.paused

    async def _pause(self, paused: bool, turn: Turn) -> None:
        state = self._state
        with self._session.settling("pause", partial(self._pause, paused)):
            state.mode.paused = (await turn.call(SetPaused(paused=paused))).paused

    async def set_qpos(self, target: str, qpos: Vector, *, by_name: bool = False, timeout: Timeout = DEFAULT) -> None:
        """Write joint positions of an articulation, run `mj_forward`, and mirror the result into `client.data`.

        Velocities and time do not change.

        Args:
            target: Actor id, or the articulation key with `by_name`; its other names are also accepted.
            qpos: All joint positions in joint order, or 7 values for a free base alone: xyz, quaternion (w, x, y, z).
            by_name: Look `target` up by the articulation key.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            UnknownArticulation: No articulation has this key or actor id.
            DimMismatch: The number of values does not fit.
            TypeError: A value is not a number; nothing was sent.
            ValueError: A value is NaN or infinite; nothing was sent.
        """
        async with self._session.turn(SetQpos, timeout=timeout) as turn:
            self._state.require_handshake("set_qpos")
            known = self._state.objects.articulations if by_name else self._state.objects.articulations_by_id
            if target not in [*known] and target in self._state.objects.articulations:
                target, by_name = self._state.objects.articulations[target].prefix, True
            values = self._positions(target, qpos, by_name=by_name)
            reply = await turn.call(SetQpos(target=target, qpos=values, target_by=target_by(by_name)))
            self._state.mirror_qpos(reply.actor_name, reply.qpos)

    def _positions(self, target: str, qpos: Vector, *, by_name: bool) -> Floats:
        if not is_array(qpos):
            raise TypeError(f"set_qpos takes numbers, got {qpos!r:.80}.")
        text("set_qpos: target", target)
        values = tuple(qpos)
        arts = self._state.objects.articulations if by_name else self._state.objects.articulations_by_id
        joints = {j.qpos_local_offset: name for name, j in arts[target].joints.items()} if target in arts else {}
        joint = ""
        for i, value in enumerate(values):
            joint = joints.get(i, joint)
            finite(f"set_qpos: qpos[{i}]{f', joint {joint!r}' if joint else ''}", value)
        return np.array(values, dtype=np.float64)

    async def get_contacts(
        self,
        *,
        body1: str | None = None,
        body2: str | None = None,
        geom1: str | None = None,
        geom2: str | None = None,
        max_contacts: int = 64,
        timeout: Timeout = DEFAULT,
    ) -> ContactsResult:
        """Return a snapshot of the active contacts.

        Filters are combined with AND. Each is a compiled name, or a short name with or without the articulation's key
        or actor id as prefix. Contacts use the names as given in the filters, and compiled names otherwise. The server
        compares `body1` and `geom1` with the first geom of a contact and `body2` and `geom2` with the second; a swapped
        pair does not match.

        Args:
            body1: Body of the first geom.
            body2: Body of the second geom.
            geom1: First geom.
            geom2: Second geom.
            max_contacts: Maximum number of contacts to return.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            KeyError: Several articulations have a body or geom of that name; nothing was sent.
        """
        names = ContactFilter(body1=body1, body2=body2, geom1=geom1, geom2=geom2)
        reply = await self._call(
            GetContacts(max_contacts=max_contacts, filter=None if names == ContactFilter() else names), timeout
        )
        return fill(ContactsResult, reply)

    async def set_sim_options(self, *, timeout: Timeout = DEFAULT, **opts: Any) -> SimOptions:
        """Change fields of `mjOption`, mirror them into `client.model.opt`, and return all options in force.

        Args:
            timeout: Seconds to wait; None waits without limit.
            **opts: Fields of `SimOptions` by name, for example `timestep=0.001, gravity=(0, 0, -1.62)`.

        Raises:
            TypeError: An option is unknown or has the wrong type; nothing was sent.
            ValueError: A value is invalid for its option, such as a timestep of 0 or NaN; nothing was sent.
            BadValue: Unknown integrator, cone or solver.
        """
        unknown = sorted(set(opts) - set(SimOptions.__struct_fields__))
        if unknown:
            known = ", ".join(SimOptions.__struct_fields__)
            raise TypeError(f"set_sim_options: unknown option {', '.join(unknown)}; it takes {known}.")
        plain: dict[str, Any] = {
            name: cast("np.ndarray[Any, Any]", value).tolist() if isinstance(value, _NUMPY) else value
            for name, value in opts.items()
        }
        try:
            with building():
                options = in_small_letters(msgspec.convert(plain, SimOptions))
            check_sim_options(options)
        except msgspec.ValidationError as error:
            raise TypeError(f"set_sim_options: {error}. Nothing was sent.") from None
        except ValueError as error:
            raise ValueError(f"set_sim_options: {error}. Nothing was sent.") from None
        async with self._session.turn(SetSimOptions, timeout=timeout) as turn:
            return await self._set_options(options, turn)

    async def _set_options(self, options: SimOptions, turn: Turn) -> SimOptions:
        with self._session.settling("options", partial(self._set_options, SimOptions())):
            in_force = in_small_letters((await turn.call(SetSimOptions(options=options))).options)
        self._state.mirror_options(in_force)
        return in_force

    async def set_user_channels(
        self,
        arts: Mapping[str, Mapping[str, Any]] | None = None,
        *,
        scene: Mapping[str, Any] | None = None,
        timeout: Timeout = DEFAULT,
    ) -> dict[str, str]:
        """Write user channels that the level declares for its robots or the scene; the state returns their values.

        Args:
            arts: Articulation to channel to value: a bool, number, string, list of numbers, or map of `pos` and `quat`.
            scene: Channel of the scene to value.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            Reasons of rejected values, by `<articulation>/<channel>` or `scene/<channel>`; empty if all were accepted.

        Raises:
            KeyError: The articulation is unknown; nothing was sent.
            UnknownOp: The server does not support user channels.
        """
        given = mapping("set_user_channels: arts", arts or {}, "articulation keys to channels")
        robots = {
            key: dict(mapping(f"set_user_channels: {key!r}", channels, "channels to values"))
            for key, channels in given.items()
        }
        request = SetUserChannels(
            arts={self._state.objects.articulations[key].prefix: channels for key, channels in robots.items()} or None,
            scene=None if scene is None else dict(mapping("set_user_channels: scene", scene, "channels to values")),
        )
        return (await self._call(request, timeout)).rejected

    async def set_camera_streaming(
        self, cameras: Mapping[str, bool | CameraTransports], *, timeout: Timeout = DEFAULT
    ) -> dict[str, CameraStreaming]:
        """Switch the streams of cameras on or off, for all clients, until play ends.

        Iterating over `frames()` does so automatically, for the duration of the iteration. This setting takes
        precedence: a camera switched on here stays on when its streams end and when the client is closed. A camera
        switched off here no longer sends to its open streams, until another stream of it is opened.

        Args:
            cameras: Camera, as `<camera>` or `<articulation>/<camera>`, to on or off, or to the transports to use.
                Transports that are not mentioned are switched off, unless none is mentioned.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            Streaming state of the cameras, by the given names, without cameras that the server no longer has.

        Raises:
            KeyError: The camera is unknown, or several articulations have it; nothing was sent.
            UnknownOp: A camera cannot be switched off because the server's cameras always stream; nothing was sent.
            GameThreadTimeout: The editor is busy; it may still execute the request later.
        """
        given = mapping("set_camera_streaming", cameras, "cameras to whether, or where, they stream")
        wanted = {name: _transports(name, how) for name, how in given.items()}
        topics = {name: self._camera_topic("set_camera_streaming", name) for name in wanted}
        switch = self._state.publishers.camera_switch
        if not self._session.features.camera_switch:
            return {name: self._always_on(name, how) for name, how in wanted.items()}
        states = (
            await switch.set({topics[name]: how for name, how in wanted.items()}, timeout=timeout) if wanted else {}
        )
        return {name: states[topic] for name, topic in topics.items() if topic in states}

    async def set_camera_delay(
        self, cameras: Mapping[str, float | CameraDelay], *, timeout: Timeout = DEFAULT
    ) -> dict[str, CameraDelayInForce]:
        """Delay the pictures of cameras, as real cameras do, for all clients, until play ends.

        The delay affects streams and `latest` pictures, but not `sync` pictures of a step.

        Args:
            cameras: Camera, as `<camera>` or `<articulation>/<camera>`, to seconds, or to a latency with jitter.
            timeout: Seconds to wait; None waits without limit.

        Returns:
            The latencies in force, by the given names, without cameras that the server no longer has.

        Raises:
            KeyError: The camera is unknown, or several articulations have it; nothing was sent.
            ValueError: A latency is negative, NaN or infinite, or its clock is unknown; nothing was sent.
            UnknownOp: The server does not support camera latency.
            GameThreadTimeout: The editor is busy; it may still execute the request later.
        """
        given = mapping("set_camera_delay", cameras, "cameras to seconds")
        wanted = {name: _latency(name, delay) for name, delay in given.items()}
        topics = {name: self._camera_topic("set_camera_delay", name) for name in wanted}
        request = SetCameraDelay(cameras={topics[name]: delay for name, delay in wanted.items()})
        delays = (await self._call(request, timeout)).cameras if wanted else {}
        return {name: delays[topic] for name, topic in topics.items() if topic in delays}

    def _camera_topic(self, op: str, name: str) -> str:
        self._state.require_handshake(op)
        return self._state.objects.require_camera(name).info.zmq_topic

    def _always_on(self, name: str, wanted: CameraTransports) -> CameraStreaming:
        if not (wanted.zmq or wanted.shm):
            raise UnknownOp(
                "unknown_op",
                f"camera {name!r} cannot be switched off: this server's cameras always stream. Nothing was sent.",
                op="set_camera_streaming",
            )
        info = self._state.objects.require_camera(name).info
        return CameraStreaming(
            streaming=True, zmq=True, shm=True, zmq_endpoint=info.zmq_endpoint, zmq_topic=info.zmq_topic
        )

    async def set_sim_speed(self, percent: float, *, timeout: Timeout = DEFAULT) -> float:
        """Set the pacing of live mode, and return the value in force, which the log mentions if the engine clamped it.

        Args:
            percent: Percent of real time; the engine clamps to 5..100.
            timeout: Seconds to wait; None waits without limit.
        """
        in_force = (await self._call(SetSimSpeed(percent=percent), timeout)).percent
        if not math.isclose(in_force, percent, rel_tol=1e-6):  # the engine answers in single precision
            log.warning(
                "set_sim_speed: %g %% was asked, %g %% is in force: the engine clamps to 5..100 %%", percent, in_force
            )
        return in_force

    async def set_mode(self, mode: StepMode | StepModeName, *, timeout: Timeout = DEFAULT) -> StepMode:
        """Switch the step mode and return the mode in force. Every mode except live resumes paused physics.

        Args:
            mode: `direct`, `puppet` or `live`; `auto` means live.
            timeout: Seconds to wait; None waits without limit.

        Raises:
            ValueError: The mode is unknown; nothing was sent.
            ModeLocked: The project is locked to another mode.
        """
        wanted = StepMode(mode)
        async with self._session.turn(SetMode, timeout=timeout) as turn:
            # On the wire `auto` is a mode in which every step times out.
            await self._state.mode.ask(turn, StepMode.LIVE if wanted is StepMode.AUTO else wanted)
            self._state.mode.wanted = self._state.mode.current
            return self._state.mode.current

    async def forward(self, *, timeout: Timeout = DEFAULT) -> ForwardOk:
        """Run `mj_forward` on the server and adopt the state: kinematics and dynamics, no integration.

        In puppet mode `client.data` does not change: there the client owns it and pushes it to the server.

        Returns:
            The state; time and step counter are unchanged.
        """
        async with self._session.turn(Forward, timeout=timeout) as turn:
            self._state.require_handshake("forward")
            reply = await turn.call(Forward())
            self._state.absorb(reply, "forward", into_mirror=not self._state.mode.puppet)
            return reply


def _transports(name: str, wanted: bool | CameraTransports) -> CameraTransports:
    if isinstance(wanted, bool):
        return CameraTransports(zmq=wanted, shm=wanted)
    require(f"set_camera_streaming: camera {name!r}", wanted, CameraTransports, "a bool or CameraTransports")
    if wanted.zmq is None and wanted.shm is None:
        return CameraTransports(zmq=True, shm=True)
    return CameraTransports(zmq=bool(wanted.zmq), shm=bool(wanted.shm))


def _latency(name: str, delay: float | CameraDelay) -> CameraDelay:
    what = f"set_camera_delay: camera {name!r}"
    wanted = delay if isinstance(delay, CameraDelay) else CameraDelay(delay_s=finite(what, delay))
    numbers = {"delay_s": wanted.delay_s, "jitter_s": wanted.jitter_s, "max_fps": wanted.max_fps or 0.0}
    for field, number in numbers.items():
        if finite(f"{what}: {field}", number) < 0:
            raise ValueError(f"{what}: {field} must be at least 0, got {number}.")
    if wanted.clock not in ("sim", "wall"):
        raise ValueError(f"{what}: clock must be 'sim' or 'wall', not {wanted.clock!r}.")
    return wanted


# A key, an actor id and the name of an engine object can all identify a robot, and each may prefix the name of a body
# or geom. The server knows only one of them, or the compiled name.


def for_the_server(request: Q, objects: SceneObjects, model: mujoco.MjModel | None) -> Q:
    """Return a request with names that the server knows. Unknown names stay unchanged.

    Raises:
        UnknownName: A name is ambiguous; nothing was sent.
    """
    match request:
        case SetTwist(articulation=str(name)) | SetControlSource(articulation=str(name)):
            robot = objects.articulations.get(name)
            return request if robot is None else replace(request, articulation=robot.prefix)
        # Later checks report names that are not text.
        case SetMocapPose(body=str(body)) | ReadMocapPose(body=str(body)):
            return replace(request, body=_compiled("body", body, objects, model))
        case GetContacts(filter=names) if names is not None:
            meant = {
                side: _compiled("body" if side.startswith("body") else "geom", name, objects, model)
                if isinstance(name, str) and name
                else name
                for side, name in asdict(names).items()
            }
            return replace(request, filter=replace(names, **meant))
        case _:
            return request


def as_written(reply: R, request: Request[Any]) -> R:
    """Return a reply with the names that the user's request contains."""
    match reply, request:
        case MocapReply(), (SetMocapPose(body=body) | ReadMocapPose(body=body)):
            return replace(reply, body=body)
        case GetContactsOk(contacts=contacts), GetContacts(filter=names) if names is not None:
            written: Mapping[str, str] = {side: name for side, name in asdict(names).items() if name}
            return replace(reply, contacts=[replace(contact, **written) for contact in contacts])
        case _:
            return reply


def _compiled(kind: Literal["body", "geom"], name: str, objects: SceneObjects, model: mujoco.MjModel | None) -> str:
    if model is None:
        return name
    known = compiled_ids(model, kind, compiled_prefixes(objects.articulations))
    return known.key(name) if name in known or name in known.aliases else name
