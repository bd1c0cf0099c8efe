"""Playing recorded joint states into a scene, and the sessions a play session can choose from.

For the handlers and, while a replay runs, the engine. The caller holds the engine's lock.
"""

from __future__ import annotations

import bisect
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from urlab_client.server.compile.scene import CompiledScene
from urlab_client.server.limits import Limits
from urlab_client.simulation.joint_recording import (
    LIVE_SESSION,
    Frame,
    JointLayout,
    LiveRecording,
    decode_csv,
    decode_json,
    joint_name,
)

logger: logging.Logger = logging.getLogger("urlab_client.server")

_DEFAULT_LIMITS: Final = Limits()

Floats = NDArray[np.float64]


class Player:
    """A session that plays in place of physics, in a loop. `advance` is a function of the time played alone."""

    def __init__(self, scene: CompiledScene, frames: Sequence[Frame], *, relative: bool) -> None:
        """Prepare to play from the first frame.

        Args:
            frames: At least one frame.
            relative: Shift free joints so that the first recorded position is where the joint is now.
        """
        self.total_frames: int = len(frames)
        self._scene = scene
        self._frames = frames
        self._relative = relative
        times = np.array([frame.time for frame in frames])
        # Where time ran back the simulation was reset: play on from there instead of searching in disorder.
        self._times: list[float] = [0.0, *np.cumsum(np.maximum(np.diff(times), 0.0)).tolist()]
        self._played = 0.0
        self._matches: dict[int, dict[int, str]] = {}
        model, free = scene.model, mujoco.mjtJoint.mjJNT_FREE
        self._qpos_adr: list[int] = [*model.jnt_qposadr.tolist(), model.nq]
        self._qvel_adr: list[int] = [*model.jnt_dofadr.tolist(), model.nv]
        self._free: list[bool] = [kind == free for kind in model.jnt_type.tolist()]
        self._names = [joint_name(model, joint) for joint in range(model.njnt)]
        self._shifts: dict[int, Floats] = {}
        if relative:
            self._find_shifts()

    @property
    def current_frame(self) -> int:
        """Index, from 0, of the newest frame that has been reached."""
        return max(0, bisect.bisect_right(self._times, self._played + self._slack()) - 1)

    def advance(self, n_steps: int) -> None:
        """Play `n_steps` timesteps further and put the scene there; what runs past the end begins again."""
        timestep = float(self._scene.model.opt.timestep)
        length = self._times[-1]
        if not 0.0 < timestep < np.inf:
            timestep = 0.0
        played = self._played + n_steps * timestep
        if played > length + self._slack():
            # One pass takes the steps that fit into it and the one that wraps to the start.
            steps = int((length + self._slack()) / timestep) + 1
            done = round(self._played / timestep) + n_steps
            played = (done % steps) * timestep
        self._played = min(played, length)
        self._apply()

    def _slack(self) -> float:
        """Return how much rounding of summed timesteps is forgiven, seconds."""
        return 1e-6 * float(self._scene.model.opt.timestep)

    def _apply(self) -> None:
        at = max(0, bisect.bisect_left(self._times, self._played) - 1)
        frame, after = self._frames[at], self._frames[min(at + 1, self.total_frames - 1)]
        span = self._times[min(at + 1, self.total_frames - 1)] - self._times[at]
        share = min((self._played - self._times[at]) / span, 1.0) if span > 0.0 else 0.0
        data = self._scene.data
        for joint, name in self._match(frame.layout).items():
            where, rates = frame.layout.joints[name]
            value = frame.qpos[where]
            following = after.layout.joints.get(name)
            if following is not None:
                target = after.qpos[following[0]]
                if len(target) == len(value):
                    value = self._between(joint, value, target, share)
            shift = self._shifts.get(joint)
            if shift is not None:
                value = np.concatenate((value[:3] + shift, value[3:]))
            data.qpos[self._qpos_adr[joint] : self._qpos_adr[joint + 1]] = value
            velocity = frame.qvel[rates]
            width = self._qvel_adr[joint + 1] - self._qvel_adr[joint]
            data.qvel[self._qvel_adr[joint] : self._qvel_adr[joint + 1]] = velocity if len(velocity) == width else 0.0
        mujoco.mj_forward(self._scene.model, data)

    def _between(self, joint: int, value: Floats, target: Floats, share: float) -> Floats:
        mixed = (1.0 - share) * value + share * target
        if self._relative and self._free[joint]:
            mixed[3:] = _slerp(value[3:], target[3:], share)
        return mixed

    def _match(self, layout: JointLayout) -> dict[int, str]:
        known = self._matches.get(id(layout))
        if known is None:
            known = self._matches[id(layout)] = self._match_joints(layout)
        return known

    def _match_joints(self, layout: JointLayout) -> dict[int, str]:
        widths = {name: where.stop - where.start for name, (where, _) in layout.joints.items()}
        local = {
            int(joint): name
            for index in self._scene.articulations
            for joint, name in zip(index.joints, index.joint_names, strict=True)
        }
        found: dict[int, str] = {}
        for joint, name in enumerate(self._names):
            width = self._qpos_adr[joint + 1] - self._qpos_adr[joint]
            fitting = [key for key in widths if widths[key] == width]
            ends = [key for key in fitting if name.endswith(f"_{key}")]
            short = local.get(joint)
            short_ends = [key for key in fitting if short and key.endswith(short)]
            if widths.get(name) == width:
                found[joint] = name
            elif ends:
                found[joint] = max(ends, key=len)
            elif short_ends:  # the shortest has the least in front: `hip` is not to follow `left_hip`
                found[joint] = min(short_ends, key=len)
        root = next((key for key in widths if widths[key] == 7), None)
        for index in self._scene.articulations:
            joints = [int(joint) for joint in index.joints]
            if root is not None and any(joint in found for joint in joints):
                for joint in joints:
                    if self._free[joint]:
                        found.setdefault(joint, root)
        return found

    def _find_shifts(self) -> None:
        first = self._frames[0]
        for joint, name in self._match(first.layout).items():
            if self._free[joint]:
                start = self._qpos_adr[joint]
                recorded = first.qpos[first.layout.joints[name][0]][:3]
                self._shifts[joint] = self._scene.data.qpos[start : start + 3] - recorded


def _slerp(value: Floats, target: Floats, share: float) -> Floats:
    cosine = float(value @ target)
    if cosine < 0.0:
        target, cosine = -target, -cosine
    if cosine > 0.9995:
        mixed = (1.0 - share) * value + share * target
    else:
        angle = np.arccos(cosine)
        mixed = (np.sin((1.0 - share) * angle) * value + np.sin(share * angle) * target) / np.sin(angle)
    norm = float(np.linalg.norm(mixed))
    return mixed / norm if norm > 0.0 else value


class ReplaySessions:
    """The sessions of a play session: the live recording and what was loaded."""

    def __init__(self, scene: CompiledScene, files: Sequence[Path] = (), limits: Limits = _DEFAULT_LIMITS) -> None:
        """Start with an empty recording.

        Args:
            files: The recordings that were there when play started; `scan` loads them.
        """
        self.live: LiveRecording = LiveRecording(scene.model, scene.data, limits.recording_bytes)
        self._most = limits.recording_file_bytes
        self.active: str = LIVE_SESSION
        self._loaded: dict[str, list[Frame]] = {}
        self._unread = files

    @property
    def names(self) -> list[str]:
        return [LIVE_SESSION, *self._loaded]

    @property
    def frames(self) -> list[Frame]:
        return list(self.live.frames) if self.active == LIVE_SESSION else self._loaded[self.active]

    def scan(self) -> None:
        """Load the recordings that were there at the start, once; what cannot be read is logged and left out."""
        unread, self._unread = self._unread, ()
        for file in unread:
            try:
                self._loaded[file.stem] = read_frames(file, self._most)
            except (OSError, ValueError) as error:
                logger.warning("%s is not a recording and is left out: %s", file, error)

    def load(self, file: Path) -> str:
        """Load a file as a session of its stem, make it active and return the name.

        Raises:
            OSError, ValueError: It cannot be read, or is not a recording.
        """
        name = file.stem
        frames = read_frames(file, self._most)
        if name.casefold() == LIVE_SESSION.casefold():
            raise ValueError(f"a session cannot be called '{name}': rename the file")
        self._loaded[name] = frames
        self.active = name
        return name

    def activate(self, name: str) -> bool:
        """Make the session with this name, in any case, the active one; return False if there is none."""
        found = next((known for known in self.names if known.casefold() == name.casefold()), None)
        if found is not None:
            self.active = found
        return found is not None


def replay_folder(root: Path) -> Path:
    return root / "URLab" / "Replays"


def recordings(folder: Path) -> list[Path]:
    """Return the files of a folder that look like recordings."""
    return sorted(file for file in folder.glob("*") if file.suffix.casefold() in (".json", ".csv"))


def read_frames(file: Path, most: int) -> list[Frame]:
    """Read a recording of at most `most` bytes.

    Raises:
        OSError, ValueError: It cannot be read, or is not a recording.
    """
    if file.exists() and not file.is_file():
        raise ValueError("it is not a regular file")
    size = file.stat().st_size
    if size > most:
        raise ValueError(f"{size} bytes are more than the limit recording_file_bytes, {most}")
    content = file.read_bytes()
    return decode_csv(content) if file.suffix.casefold() == ".csv" else decode_json(content)
