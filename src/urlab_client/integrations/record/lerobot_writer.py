"""Recordings as LeRobot datasets, written by LeRobot itself in an interpreter that has it."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from urlab_client.integrations.record.contents import Table
from urlab_client.integrations.record.pixels import even, farthest, visible
from urlab_client.integrations.record.reader import Run
from urlab_client.integrations.record.transitions import GOAL, Episodes, transitions_of
from urlab_client.integrations.record.writer import RecordingError

__all__ = ["write_lerobot"]

_SCRIPT = Path(__file__).with_name("_lerobot_script.py")
_DEADLINE_S = 3600.0
_PROBE_S = 120.0
_SLACK = 1.01  # of times that were rounded on their way
_SLACK_S = 1e-6


def write_lerobot(
    run: Run,
    folder: Path,
    *,
    python: str,
    task: str,
    fps: int | None = None,
    robot_type: str | None = None,
    cameras: Sequence[str] | None = None,
    video: bool = True,
    max_picture_age: float | None = None,
    episodes: Episodes = "kept",
    progress: Callable[[int], None] | None = None,
) -> int:
    """Write a LeRobot dataset with LeRobot itself, in an interpreter that has it; return the number of frames.

    A frame is a state and the action taken at it: `observation.state` holds the positions of all articulations,
    `action` the set-points that were in force from then on, and `observation.images.NAME` the pictures, with dots for
    slashes. An episode ends at each reset; its last state, at which nothing was done any more, is no frame. At every
    1/fps seconds of an episode the newest state and picture are taken, beginning with its first picture.

    Args:
        run: The recording.
        folder: The dataset, which must not exist.
        python: Interpreter that can import `lerobot` 0.6.
        task: What the robot does, in words.
        fps: Frames per second; by default the rate of the pictures, without any that of the states.
        robot_type: Kind of robot; the names of the articulations, joined by `+`, by default.
        cameras: Cameras; all that were recorded by default.
        video: Store pictures as video, which loses some detail, rather than as PNG files.
        max_picture_age: Largest age of a picture beside its state, seconds; one frame by default.
        episodes: Which episodes; see `transitions_of`. What they are about is in `observation.environment_state`.
        progress: Told now and then how many bytes have been read.

    Raises:
        FileExistsError: The folder exists.
        RecordingError: The interpreter has no LeRobot, there is nothing to write, pictures are missing so that a frame
            would show an older state, the rate is not a whole number, or LeRobot failed.
        KeyError: There are no pictures of a camera.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists: LeRobot makes the folder itself")
    _check(python)
    everything = run.table(progress)
    table = transitions_of(run, only=episodes)
    names = run.cameras() if cameras is None else list(cameras)
    with tempfile.TemporaryDirectory(prefix="urlab-lerobot-") as temporary:
        work = Path(temporary)
        times = {name: _save_pictures(run, name, work / str(i), video, progress) for i, name in enumerate(names)}
        rate = _rate(run, [*times.values()] or [everything.time]) if fps is None else fps
        rows = _resampled(table, rate, [*times.values()], _episode_starts(everything))
        if not len(rows):
            raise RecordingError(f"{run.path}: there is nothing to make a dataset of.")
        limit = 1 / rate if max_picture_age is None else max_picture_age
        pictures = [_newest(run, name, when, table.time[rows], limit) for name, when in times.items()]
        state, action = _joined(table, "qpos"), _joined(table, "action")
        goal = _goal(table)
        if not np.isfinite(goal[1][rows]).all():
            raise RecordingError(f"{run.path}: it is not known what some of its episodes were about.")
        arrays: dict[str, Any] = {
            "state": state[1][rows].astype(np.float32),
            "action": action[1][rows].astype(np.float32),
            "goal": goal[1][rows].astype(np.float32),
            "episode": table.episode[rows],
            **{f"picture{i}": chosen for i, chosen in enumerate(pictures)},
        }
        np.savez(work / "states.npz", allow_pickle=False, **arrays)
        robots = [key.removesuffix("/action") for key in table.columns if key.endswith("/action")]
        plan = {
            "folder": str(folder.absolute()),
            "fps": rate,
            "task": task,
            "robot_type": "+".join(robots) if robot_type is None else robot_type,
            "state": state[0],
            "action": action[0],
            "goal": goal[0],
            "cameras": [name.replace("/", ".") for name in names],
            "video": video,
        }
        (work / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
        _run(python, work)
    return len(rows)


def _check(python: str) -> None:
    try:
        done = subprocess.run(  # noqa: S603  # the user's own interpreter
            [python, "-c", "import lerobot"], capture_output=True, text=True, timeout=_PROBE_S, check=False
        )
    except OSError as error:
        raise RecordingError(f"{python} cannot be run: {error.strerror}.", hint="Name a Python interpreter.") from error
    except subprocess.TimeoutExpired:
        raise RecordingError(f"{python} did not import lerobot within {_PROBE_S:g} s.") from None
    if done.returncode:
        raise RecordingError(
            f"{python} has no LeRobot: {_last_line(done.stderr)}.",
            hint="Make an environment for it (pip install 'lerobot[dataset]') and name its interpreter with --python.",
        )


def _run(python: str, work: Path) -> None:
    try:
        done = subprocess.run(  # noqa: S603  # the user's own interpreter
            [python, "-P", str(_SCRIPT), str(work)], capture_output=True, text=True, timeout=_DEADLINE_S, check=False
        )
    except subprocess.TimeoutExpired:
        raise RecordingError(f"LeRobot did not finish within {_DEADLINE_S:g} s.") from None
    if done.returncode:
        raise RecordingError(f"LeRobot failed: {_last_line(done.stderr)}.")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _save_pictures(
    run: Run, camera: str, folder: Path, video: bool, progress: Callable[[int], None] | None
) -> NDArray[np.float64]:
    folder.mkdir()
    times: list[float] = []
    far = 0.0
    for i, picture in enumerate(run.frames(camera, progress)):
        far = far or farthest(picture.pixels)
        pixels = visible(picture.pixels, far)
        Image.fromarray(even(pixels) if video else pixels).save(folder / f"{i}.png", compress_level=1)
        times.append(picture.time)
    return np.array(times)


def _rate(run: Run, times: list[NDArray[np.float64]]) -> int:
    distances = np.concatenate([np.diff(when) for when in times])
    distances = distances[distances > _SLACK_S]
    rate = 1 / float(np.median(distances)) if len(distances) else 0.0
    if round(rate) < 1 or abs(rate - round(rate)) > 0.01 * rate:
        raise RecordingError(
            f"{run.path}: LeRobot wants whole frames per second, and the recording has {rate:.3g}.",
            hint="Name the rate with --fps.",
        )
    return round(rate)


def _episode_starts(table: Table) -> dict[int, float]:
    episodes, first = np.unique(table.episode, return_index=True)
    return dict(zip(episodes.tolist(), table.time[first].tolist(), strict=True))


def _resampled(
    table: Table, fps: int, pictures: list[NDArray[np.float64]], starts: dict[int, float]
) -> NDArray[np.intp]:
    """Return the row of the newest state at each 1/fps seconds of each episode, from its first pictures on."""
    rows: list[NDArray[np.intp]] = []
    for episode in np.unique(table.episode).tolist():
        own = np.flatnonzero(table.episode == episode)
        first, last = float(table.time[own[0]]), float(table.time[own[-1]])
        for times in pictures:
            later = times[times >= starts[episode] - _SLACK_S]
            first = max(first, float(later[0]) if len(later) else np.inf)
        if first <= last + _SLACK_S:
            grid = first + np.arange(int((last - first) * fps + _SLACK_S) + 1) / fps
            found = np.searchsorted(table.time[own], grid + _SLACK_S, side="right") - 1
            rows.append(own[np.maximum(found, 0)])
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.intp)


def _newest(
    run: Run, camera: str, times: NDArray[np.float64], states: NDArray[np.float64], limit: float
) -> NDArray[np.intp]:
    """Return the newest picture at each state.

    Raises:
        RecordingError: One is older than `limit` seconds.
    """
    chosen = np.searchsorted(times, states + _SLACK_S, side="right") - 1
    age = states - times[chosen]
    stale = np.flatnonzero(age > _SLACK * limit + _SLACK_S)
    if len(stale):
        raise RecordingError(
            f"{run.path}: {len(stale)} of {len(states)} frames would show an older picture of {camera}, the first one "
            f"{age[stale[0]]:.3f} s old, at {states[stale[0]]:.3f} s.",
            hint="Record with camera_hz of at least --fps, choose a lower --fps, or allow older pictures with "
            "--max-picture-age SECONDS.",
        )
    return chosen


def _goal(table: Table) -> tuple[list[str], NDArray[np.float64]]:
    chosen = {key.partition("/")[2]: column for key, column in table.columns.items() if key.startswith(f"{GOAL}/")}
    names = [f"{key}.{name}" for key, column in chosen.items() for name in column.names]
    values = [column.values for column in chosen.values()]
    return names, np.concatenate(values, axis=1) if values else np.zeros((len(table), 0))


def _joined(table: Table, field: str) -> tuple[list[str], NDArray[np.float64]]:
    chosen = {key: column for key, column in table.columns.items() if key.endswith(f"/{field}")}
    names = [f"{key.rpartition('/')[0]}.{name}" for key, column in chosen.items() for name in column.names]
    values = [column.values for column in chosen.values()]
    return names, np.concatenate(values, axis=1) if values else np.zeros((len(table), 0))
