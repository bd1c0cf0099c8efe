"""The articulations of a running scene: by what requests call them, and what the commands of a step do to each."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client._mujoco import reset_controls
from urlab_client.protocol.messages.session import ArticulationCommand
from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.compile.scene_index import ArticulationIndex
from urlab_client.server.dialects import Dialect
from urlab_client.server.physics.controllers import ArticulationControl, ControlSource, Twist
from urlab_client.server.refusal import Refusal
from urlab_client.simulation.controller_config import ControllerConfig


class Articulations:
    """The articulations of a scene. The caller holds the engine's lock, except to look names up.

    Attributes:
        controls: Set-points, controller and twist of each articulation, by what it is called in requests and replies.
        names: What each articulation is called in requests and replies, by the key of its compiled names.
    """

    def __init__(self, scene: CompiledScene, controllers: Mapping[str, ControllerConfig], dialect: Dialect) -> None:
        """Give each articulation of a scene neutral set-points and its controller.

        Args:
            controllers: Controller to attach by articulation key; `*` means all keys not listed.
        """
        self._model = scene.model
        self._data = scene.data
        self._qpos = scene.data.qpos
        self._qvel = scene.data.qvel
        self._ctrl = scene.data.ctrl
        self._xfrc = scene.data.xfrc_applied
        neutral = self._neutral_ctrl()
        everyone = controllers.get("*")
        self.controls: Mapping[str, ArticulationControl] = MappingProxyType(
            {
                name: ArticulationControl(
                    self._model,
                    index,
                    neutral,
                    controllers.get(index.key, everyone),
                    exact=not dialect.controls_float32,
                )
                for name, index in _named(scene, dialect)
            }
        )
        self._steered = [control for control in self.controls.values() if control.controller is not None]
        self._folded = _folded(self.controls, dialect)
        self.names: Mapping[str, str] = {control.index.key: name for name, control in self.controls.items()}

    def _neutral_ctrl(self) -> NDArray[np.float64]:
        kept = self._ctrl.copy()
        reset_controls(self._model, self._data)
        neutral = self._ctrl.copy()
        self._ctrl[:] = kept
        return neutral

    def find(self, key: str) -> ArticulationControl | None:
        """Return the articulation with this key, preferring the exact spelling to another case; None if unknown."""
        control = self.controls.get(key)
        return self._folded.get(key.casefold()) if control is None else control

    def control(self, key: str) -> ArticulationControl:
        control = self.find(key)
        if control is None:
            raise Refusal("unknown_articulation", key)
        return control

    def set_source(self, source: ControlSource, key: str | None = None) -> None:
        for control in self.controls.values() if key is None else [self.control(key)]:
            control.set_points.source = source

    def set_twist(self, key: str, linear: Sequence[float], angular: Sequence[float]) -> Twist:
        """Store a commanded twist (m/s, rad/s, base frame) and return it as stored."""
        twist = self.control(key).twist
        twist.set(linear, angular)
        return twist

    def configure_controller(self, key: str, params: object) -> dict[str, Any]:
        """Change controller parameters, switch the controller on and return all parameters.

        Args:
            params: Parameter names to values; anything but a mapping changes nothing.
        """
        controller = self.control(key).controller
        if controller is None:
            raise Refusal("no_controller", f"articulation '{key}' has no controller attached")
        if isinstance(params, Mapping):
            controller.configure(cast("Mapping[str, object]", params))
        return controller.params()

    def stage_positional(self, commands: Mapping[str, ArticulationCommand]) -> None:
        with np.errstate(over="ignore"):  # infinite, as in C; entered once for all robots
            for key, command in commands.items():
                control = self.find(key)
                if control is not None and command.ctrl is not None:
                    control.set_points.stage(command.ctrl)

    def stage_named(self, commands: Mapping[str, ArticulationCommand]) -> set[ArticulationControl]:
        """Stage `ctrl_map` and return the articulations whose controller the request bypasses."""
        raw: set[ArticulationControl] = set()
        for key, command in commands.items():
            control = self.find(key)
            if control is None:
                continue
            if command.ctrl_map:
                control.set_points.stage_named(command.ctrl_map)
            if command.control_mode is not None and command.control_mode.casefold() == "raw":
                raw.add(control)
        return raw

    def write_raw(self, commands: Mapping[str, ArticulationCommand]) -> Mapping[str, ArticulationCommand]:
        """Write the controls of `raw` commands past controllers and set-points; return the other commands.

        What a live loop makes of set-points and controllers takes their place at its next iteration.
        """
        others = dict(commands)
        for key, command in commands.items():
            control = self.find(key)
            if control is None or command.control_mode is None or command.control_mode.casefold() != "raw":
                continue
            del others[key]
            staged = control.set_points.network.copy()
            self.stage_positional({key: command})
            control.set_points.stage_named(command.ctrl_map or {})
            control.apply(self._qpos, self._qvel, self._ctrl, raw=True)
            control.set_points.network[:] = staged
        return others

    def zero_set_points(self) -> None:
        for control in self.controls.values():
            control.set_points.network[:] = 0.0
            control.set_points.ui[:] = 0.0

    def any_controlled(self, raw: Container[ArticulationControl]) -> bool:
        """Whether a controller computes the controls of any articulation, where those in `raw` bypass theirs."""
        return bool(self._steered) and any(control.controlled(raw=control in raw) for control in self._steered)

    def apply_controls(self, raw: Container[ArticulationControl] = ()) -> None:
        """Write `mjData.ctrl` from set-points and controllers; those of the articulations in `raw` are bypassed."""
        for control in self.controls.values():
            control.apply(self._qpos, self._qvel, self._ctrl, raw=control in raw)

    def apply_wrenches(self, commands: Mapping[str, ArticulationCommand]) -> list[int]:
        """Write `xfrc_applied` and return the bodies concerned."""
        bodies: list[int] = []
        for key, command in commands.items():
            for name, wrench in (command.xfrc_applied or {}).items():
                body = self._id(mujoco.mjtObj.mjOBJ_BODY, f"{key}_{name}")
                if body < 0:
                    body = self._id(mujoco.mjtObj.mjOBJ_BODY, name)
                if body >= 0 and len(wrench) == 6:
                    self._xfrc[body] = wrench
                    bodies.append(body)
        return bodies

    def clear_wrenches(self, bodies: list[int]) -> None:
        if bodies:
            self._xfrc[bodies] = 0.0

    def override_joints(self, overrides: Mapping[str, Mapping[str, float]]) -> None:
        """Set the first coordinate of joints, by articulation and joint name; unknown names are ignored."""
        for key, joints in overrides.items():
            control = self.find(key)
            if control is None:
                continue
            for name, value in joints.items():
                joint = self._id(mujoco.mjtObj.mjOBJ_JOINT, f"{control.index.prefix}{name}")
                if joint < 0:
                    joint = self._id(mujoco.mjtObj.mjOBJ_JOINT, name)
                if joint >= 0:
                    self._qpos[self._model.jnt_qposadr[joint]] = value

    def _id(self, kind: int, name: str) -> int:
        return mujoco.mj_name2id(self._model, kind, name)


def _named(scene: CompiledScene, dialect: Dialect) -> list[tuple[str, ArticulationIndex]]:
    """Map names to articulations. If two share a name, the second is named after its actor."""
    named: dict[str, ArticulationIndex] = {}
    for index in scene.articulations:
        name = dialect.robot_key(index.actor_id, index.key)
        named[index.key if name in named else name] = index
    return list(named.items())


def _folded(controls: Mapping[str, ArticulationControl], dialect: Dialect) -> dict[str, ArticulationControl]:
    """Return the articulations by all that requests may call them, in one case; the first to claim a name has it."""
    folded = {name.casefold(): control for name, control in reversed([*controls.items()])}
    if dialect.public_names:
        for control in controls.values():
            for name in (control.index.key, control.index.actor_id):
                if name:
                    folded.setdefault(name.casefold(), control)
    return folded
