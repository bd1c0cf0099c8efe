"""State of entities and articulations as last received, and the commands that wait for the next step.

The client writes these records and the wrappers that users hold read them. A wrapper keeps working when `discover()`
binds its record to a new model.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from urlab_client._mujoco import contiguous, control_counts, control_starts
from urlab_client.aio.model.layout import JOINT_TRANSMISSIONS, ArticulationLayout
from urlab_client.aio.model.mirror import Mirror
from urlab_client.enums import ControllerKind, ControlMode
from urlab_client.errors import ProtocolError
from urlab_client.protocol.base import Floats
from urlab_client.protocol.messages.session import (
    ArticulationCommand,
    ArticulationInfo,
    ArticulationState,
    BodyPose,
    ControllerInfo,
    EntityInfo,
    EntityState,
    TwistState,
)

if TYPE_CHECKING:
    from urlab_client.aio.model.elements import ArticulationElements

Wrenches = dict[str, list[float]]
"""(fx, fy, fz, tx, ty, tz) by body."""


class MirroredEntity:
    """State of one dynamic body.

    Attributes:
        mirror: The client's local model and data.
        name: Key in `client.entities`.
        body_id: Global MuJoCo id of the (root) body; -1 if unknown.
        free_joint: Compiled name of the free joint, or None.
        has_free_base: True when the (root) body has a free joint.
        qpos_offset: Start of the free joint in `mjData.qpos`, or None.
        qvel_offset: Start of the free joint in `mjData.qvel`, or None.
        pose: Latest state of a plain entity.
        wrenches: Wrenches that the next step sends.
    """

    def __init__(self, mirror: Mirror, name: str) -> None:
        self.mirror = mirror
        self.name = name
        self.body_id: int = -1
        self.free_joint: str | None = None
        self.has_free_base: bool = False
        self.qpos_offset: int | None = None
        self.qvel_offset: int | None = None
        self.pose: EntityState | None = None
        self.wrenches: Wrenches = {}

    def bind_entity(self, info: EntityInfo, *, keep: bool) -> None:
        """Adopt the description from a handshake, and keep the state or forget it."""
        self.body_id = info.id
        self.has_free_base = info.has_free_base
        self.free_joint = info.free_joint
        self.qpos_offset = info.qpos_offset
        self.qvel_offset = info.qvel_offset
        if not keep:
            self.pose = None

    def check_pose(self, state: EntityState, op: str) -> None:
        """Raise `ProtocolError` if an array does not have the length of a pose or a velocity."""
        for what, array, expected in (("qpos", state.qpos, 7), ("qvel", state.qvel, 6)):
            if array is not None and len(array) != expected:
                raise ProtocolError(
                    f"{op}: {what} of entity {self.name!r} has {len(array)} values, not {expected}.", op=op
                )

    def absorb_pose(self, state: EntityState, *, into_mirror: bool) -> None:
        """Store a checked state here and, if requested, in the mirror. Call under the mirror's lock."""
        self.pose = state
        data = self.mirror.data
        if data is None:  # otherwise it is read from the mirror
            qpos, qvel = (None if array is None else array.copy() for array in (state.qpos, state.qvel))
            self.pose = EntityState(xpos=state.xpos, xquat=state.xquat, qpos=qpos, qvel=qvel)
            return
        if not into_mirror or self.qpos_offset is None or self.qvel_offset is None:
            return
        if state.qpos is not None and state.qvel is not None:
            data.qpos[self.qpos_offset : self.qpos_offset + 7] = state.qpos
            data.qvel[self.qvel_offset : self.qvel_offset + 6] = state.qvel

    def root_qpos(self) -> Floats | None:
        """Free-joint position, shape (7,), or None without a free base."""
        data = self.mirror.data
        if data is not None and self.qpos_offset is not None:
            return data.qpos[self.qpos_offset : self.qpos_offset + 7].copy()
        return None if self.pose is None or self.pose.qpos is None else self.pose.qpos.copy()

    def root_qvel(self) -> Floats | None:
        """Free-joint velocity, shape (6,), or None without a free base."""
        data = self.mirror.data
        if data is not None and self.qvel_offset is not None:
            return data.qvel[self.qvel_offset : self.qvel_offset + 6].copy()
        return None if self.pose is None or self.pose.qvel is None else self.pose.qvel.copy()

    def wrench_command(self, wrenches: Wrenches) -> ArticulationCommand:
        return ArticulationCommand(xfrc_applied=wrenches)

    def apply_wrench(self, body: str, wrench: list[float]) -> None:
        """Buffer a wrench for the next step, replacing any earlier one on the same body. Call from any thread."""
        with self.mirror.lock:
            self.wrenches[body] = wrench

    def take_wrenches(self) -> Wrenches:
        with self.mirror.lock:
            taken, self.wrenches = self.wrenches, {}
        return taken


class SetPoints(np.ndarray[Any, np.dtype[np.float64]]):
    """The view of an articulation's set-points that users write to. Assigning to its items drives the articulation.

    Reading drives nothing, and neither do copies. Results of computations are plain arrays.
    """

    _on_write: Callable[[], None] | None = None  # None in arrays made from the view

    @classmethod
    def of(cls, ctrl: Floats, on_write: Callable[[], None]) -> SetPoints:
        """Return the view of an array, with the callback for writes."""
        view = ctrl.view(cls)
        view._on_write = on_write  # noqa: SLF001  # its own class
        return view

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(key, value)
        # The same values as before count, too: the server may have others from an earlier owner.
        if self._on_write is not None:
            self._on_write()

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False, /) -> Any:
        plain = np.asarray(array)  # NumPy 1 passes a view of this class, and does not say that it wants a scalar
        return plain[()] if return_scalar or not plain.ndim else plain


class MirroredArticulation(MirroredEntity):
    """State of one articulation.

    It owns its arrays. Those of a reply belong to its reader, who may write to them. For the same reason, readers of
    this record get copies.

    Attributes:
        layout: Addresses of its values in the compiled model.
        elements: Handles of its joints, actuators, sensors and bodies once they were asked for.
        info: Description from the handshake.
        controller: Controller block from the handshake, kept current.
        control_mode: Whether the controller is active.
        ctrl: Set-points that the next step sends, shape (n_ctrl,).
        set_points: View of `ctrl` that users write to.
        qpos: Joint positions.
        qvel: Joint velocities.
        applied: `mjData.ctrl` as the server applied it.
        act: First activation per actuator.
        force: Actuator forces, at level `full`.
        sensors: Readings by short name.
        user: Values of the user channels, by name.
        bodies: Poses by short name, at level `full`.
        twist: Commanded twist.
        actions: Bit field of pressed action keys.
    """

    info: ArticulationInfo
    layout: ArticulationLayout

    def __init__(self, mirror: Mirror, info: ArticulationInfo, layout: ArticulationLayout) -> None:
        super().__init__(mirror, info.prefix)
        self.controller: ControllerInfo | None = None
        self.control_mode: ControlMode = ControlMode.RAW
        self._driven = False
        self._use_ctrl(0)
        self.user: dict[str, Any] = {}
        self.bind(info, layout, keep=False)

    def bind(self, info: ArticulationInfo, layout: ArticulationLayout, *, keep: bool) -> None:
        """Adopt the description from a handshake. Keep set-points and control mode if they still fit."""
        n_ctrl = len(info.actuator_types) if self.mirror.model is None else len(layout.ctrl_adr)
        self.info, self.layout = info, layout
        self.elements: ArticulationElements | None = None
        self._lengths = len(layout.qpos_adr), len(layout.qvel_adr), len(layout.ctrl_adr)
        self._sensor_names = [*layout.sensor_dims]
        self._sensor_dims = [*layout.sensor_dims.values()]
        keep = keep and len(self.ctrl) == n_ctrl
        if len(self.ctrl) != n_ctrl:
            self._use_ctrl(n_ctrl)
        self._bind_controller(info.controller)
        self._bind_root()
        data = self.mirror.data
        # Looking up MuJoCo's arrays takes as long as writing to them.
        self._mirrored = None if data is None else (data.qpos, data.qvel, data.ctrl, data.act)
        self._places = contiguous(layout.qpos_adr), contiguous(layout.qvel_adr), contiguous(layout.ctrl_adr)
        if keep:
            return
        self.qpos: Floats = np.zeros(0) if data is None else data.qpos[layout.qpos_adr]
        self.qvel: Floats = np.zeros(0) if data is None else data.qvel[layout.qvel_adr]
        self.applied: Floats = np.zeros(n_ctrl)
        self.act: Floats = np.zeros(n_ctrl)
        self.force: Floats | None = None
        self.sensors: dict[str, list[float]] = {}
        self.user = {}
        self.bodies: dict[str, BodyPose] | None = None
        self.twist: TwistState | None = None
        self.actions: int = 0

    def _use_ctrl(self, n_ctrl: int) -> None:
        self.ctrl: Floats = np.zeros(n_ctrl)
        self.set_points: SetPoints = SetPoints.of(self.ctrl, self.drive)
        self._written_ctrl: Floats = np.zeros(n_ctrl)
        self._left: list[float] = [0.0] * n_ctrl

    def _bind_controller(self, info: ControllerInfo | None) -> None:
        before = self.controller
        if before is not None and info is not None and before.kind == info.kind:
            # In place, so that views a user holds stay current.
            for kept, fresh in ((before.params, info.params), (before.schema, info.schema)):
                kept.clear()
                kept.update(fresh)
            return
        self.controller = info
        self.control_mode = ControlMode.RAW if info is None else ControlMode.UE_CONTROLLER

    def _bind_root(self) -> None:
        model, layout = self.mirror.model, self.layout
        self.body_id: int = layout.root_body
        self.has_free_base: bool = layout.free_joint >= 0
        self.free_joint = self.qpos_offset = self.qvel_offset = None
        if model is not None and self.has_free_base:
            name = next(name for name, i in layout.joints.items() if i == layout.free_joint)
            self.free_joint = f"{self.info.compiled_prefix}_{name}"
            self.qpos_offset = int(model.jnt_qposadr[layout.free_joint])
            self.qvel_offset = int(model.jnt_dofadr[layout.free_joint])

    def root_qpos(self) -> Floats | None:
        return self.qpos[:7].copy() if self.has_free_base else None

    def root_qvel(self) -> Floats | None:
        return self.qvel[:6].copy() if self.has_free_base else None

    def check(self, state: ArticulationState, op: str) -> None:
        """Raise `ProtocolError` if an array does not fit the model, before any part of the reply is applied."""
        if self.mirror.model is None:
            return
        # This runs for each robot in each reply: locate the problem only if there is one.
        n_qpos, n_qvel, n_ctrl = self._lengths
        ctrl, act, force, sensors = state.ctrl, state.act, state.actuator_force, state.sensors
        if (
            len(state.qpos) == n_qpos
            and len(state.qvel) == n_qvel
            and (ctrl is None or len(ctrl) == n_ctrl)
            and (act is None or len(act) == n_ctrl)
            and (force is None or len(force) == self.layout.n_out)
            and (
                not sensors or ([*map(len, sensors.values())] == self._sensor_dims and [*sensors] == self._sensor_names)
            )
        ):
            return
        self._fits(op, "qpos", state.qpos, n_qpos)
        self._fits(op, "qvel", state.qvel, n_qvel)
        self._fits(op, "ctrl", ctrl, n_ctrl)
        self._fits(op, "act", act, n_ctrl)
        self._fits(op, "actuator_force", force, self.layout.n_out)
        for name, reading in (sensors or {}).items():
            self._fits(op, f"sensor {name!r}", reading, self.layout.sensor_dims.get(name, len(reading)))

    def check_written(self, qpos: Floats) -> None:
        """Raise `ProtocolError` for positions that cover neither the whole articulation nor its free base."""
        if self.mirror.model is not None and not (self.has_free_base and len(qpos) == 7):
            self._fits("set_qpos", "qpos", qpos, len(self.layout.qpos_adr))

    def _fits(self, op: str, what: str, array: Floats | list[float] | None, expected: int) -> None:
        if array is not None and len(array) != expected:
            raise ProtocolError(
                f"{op}: {what} of articulation {self.name!r} has {len(array)} values, but its model has {expected}.",
                op=op,
                hint="The model changed on the server: call discover().",
            )

    def absorb(self, state: ArticulationState, *, into_mirror: bool) -> None:
        """Store a checked state here and, if requested, in the mirror's data. Call under the mirror's lock."""
        qpos, qvel, ctrl, act = state.qpos, state.qvel, state.ctrl, state.act
        self.qpos, self.qvel = qpos.copy(), qvel.copy()
        self.force = None if state.actuator_force is None else state.actuator_force.copy()
        self.bodies = state.bodies
        if ctrl is not None:
            self.applied = ctrl.copy()
        if act is not None:
            self.act = act.copy()
        if state.sensors is not None:
            self.sensors = state.sensors
        if state.user is not None:
            self.user = state.user
        if state.twist is not None:
            self.twist = state.twist
        if state.actions is not None:
            self.actions = state.actions
        if into_mirror and self._mirrored is not None:
            all_qpos, all_qvel, all_ctrl, all_act = self._mirrored
            qpos_places, qvel_places, ctrl_places = self._places
            all_qpos[qpos_places] = qpos
            all_qvel[qvel_places] = qvel
            if ctrl is not None:
                all_ctrl[ctrl_places] = ctrl
            if act is not None and len(all_act):
                all_act[self.layout.act_adr] = act[self.layout.act_from]

    def write_set_points(self) -> None:
        """Write the set-points to the mirror's `ctrl` if they changed since the last call, for a puppet step.

        If they did not change, leave `ctrl` alone: in puppet mode the user writes `client.data.ctrl`.

        Raises:
            ValueError: A set-point is NaN or infinite.
        """
        self._set_points()
        data = self.mirror.data
        if data is not None and not np.array_equal(self.ctrl, self._written_ctrl):
            data.ctrl[self.layout.ctrl_adr] = self.ctrl
            self._written_ctrl = self.ctrl.copy()

    def drive(self) -> None:
        """Let this client control the articulation from the next step on."""
        self._driven = True

    def leave(self) -> None:
        """Stop controlling the articulation until the next write."""
        self._driven = False
        self._left = self.ctrl.tolist()

    @property
    def driven(self) -> bool:
        """Whether this client controls the articulation: it called `drive` or changed a set-point in any way."""
        return self._driven or self.ctrl.tolist() != self._left

    def live_command(self) -> ArticulationCommand:
        """Return the command of a live step; the server ignores everything but `ctrl`."""
        return ArticulationCommand(ctrl=self._set_points())

    def direct_command(self, wrenches: Wrenches | None) -> ArticulationCommand:
        """Return the command of a direct step that carries these wrenches."""
        bypass = self.controller is not None and self.control_mode is ControlMode.RAW
        return ArticulationCommand(
            ctrl=self._set_points(),
            control_mode=str(ControlMode.RAW) if bypass else None,
            xfrc_applied=self._compiled(wrenches) if wrenches else None,
        )

    def _set_points(self) -> list[float]:
        values: list[float] = self.ctrl.tolist()
        # The sum is not finite if any value is not, and it costs a tenth of checking each value.
        if not math.isfinite(sum(values)) and (invalid := self.not_finite()):
            problem = f"set-points of articulation {self.name!r} are not finite: {', '.join(invalid)}"
            raise ValueError(f"step: {problem}. Nothing was sent.")
        if not self._driven and values != self._left:
            self._driven = True  # also after a later write of the values from before
        return values

    def not_finite(self) -> list[str]:
        """Return the set-points that are NaN or infinite, as `'elbow' nan`."""
        return [f"{self.input_name(i)} {self.ctrl[i]}" for i in np.flatnonzero(~np.isfinite(self.ctrl)).tolist()]

    def out_of_range(self) -> list[str]:
        """Return the set-points outside their range, as `'elbow' 5 (-1 to 1)`."""
        low, high = self.ranges()
        outside = np.flatnonzero((self.ctrl < low) | (self.ctrl > high)).tolist()
        return [f"{self.input_name(i)} {self.ctrl[i]:g} ({low[i]:g} to {high[i]:g})" for i in outside]

    def input_name(self, i: int) -> str:
        """Return the quoted name of a set-point's actuator, with the input number if it has several inputs."""
        model = self.mirror.model
        if model is None:
            return repr([*self.info.actuator_types][i])
        counts = control_counts(model)
        for name, actuator in self.layout.actuators.items():
            count = int(counts[actuator])
            if i < count:
                return repr(name) if count == 1 else f"{name!r} input {i}"
            i -= count
        raise IndexError(i)

    @property
    def takes_positions(self) -> bool:
        """Whether set-points are joint positions because a PD controller is active."""
        controller = self.controller
        return (
            controller is not None
            and controller.kind == ControllerKind.PD
            and self.control_mode is ControlMode.UE_CONTROLLER
        )

    def ranges(self) -> tuple[Floats, Floats]:
        """Return the lower and upper bound of each set-point; infinite if unlimited or unknown.

        Set-points are controls. While a PD controller is active, they are positions of the driven joints.
        """
        low, high = np.full(len(self.ctrl), -np.inf), np.full(len(self.ctrl), np.inf)
        model = self.mirror.model
        if model is None:
            return low, high
        positions = self.takes_positions
        counts, starts = control_counts(model), control_starts(model)
        start = 0
        for actuator in self.layout.actuators.values():
            count, first = int(counts[actuator]), int(starts[actuator])
            joint = int(model.actuator_trnid[actuator][0])
            if not positions:
                limited = model.actuator_ctrllimited[first : first + count].astype(bool)
                bounds = model.actuator_ctrlrange[first : first + count]
            elif count == 1 and model.actuator_trntype[actuator] in JOINT_TRANSMISSIONS:
                limited, bounds = model.jnt_limited[[joint]].astype(bool), model.jnt_range[[joint]]
            else:
                limited, bounds = np.zeros(count, dtype=bool), np.zeros((count, 2))
            where = start + np.flatnonzero(limited)
            low[where], high[where] = bounds[limited].T
            start += count
        return low, high

    def _compiled(self, wrenches: Wrenches) -> Wrenches:
        """Return wrenches by names that the server resolves: only compiled ones if robots have public names."""
        if self.info.actor_name is None:
            return wrenches
        return {f"{self.info.compiled_prefix}_{body}": wrench for body, wrench in wrenches.items()}

    def body_pose(self, name: str, body_id: int) -> tuple[Floats, Floats] | None:
        """Return world position and orientation (w, x, y, z), received at level `full` or from the mirror; or None."""
        with self.mirror.lock:
            if self.bodies is not None and name in self.bodies:
                received = self.bodies[name]
                return np.array(received.xpos), np.array(received.xquat)
            pair = self.mirror.derived()
            return None if pair is None else (pair[1].xpos[body_id].copy(), pair[1].xquat[body_id].copy())


SentWrenches = dict[MirroredEntity, Wrenches]
"""The wrenches of one step, by the record that they were applied to."""


def restore_wrenches(sent: SentWrenches) -> None:
    """Buffer the wrenches of a step that was not executed again, unless newer ones were applied."""
    for record, wrenches in sent.items():
        with record.mirror.lock:
            record.wrenches = {**wrenches, **record.wrenches}
