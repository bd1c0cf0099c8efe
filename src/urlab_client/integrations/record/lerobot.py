"""Conversion of recordings to LeRobot datasets, by LeRobot itself in an interpreter that has it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from urlab_client._platform.signals import APART
from urlab_client.integrations._feed.messages import OutcomeMessage
from urlab_client.integrations.record.contents import Column, Table, even, farthest, visible
from urlab_client.integrations.record.index import Progress
from urlab_client.integrations.record.reader import Run, phases
from urlab_client.integrations.record.transitions import (
    Episodes,
    Pairs,
    check_episodes,
    pairs_at,
    selected_pairs,
    with_goals,
)
from urlab_client.integrations.record.writer import GOAL, TASK, RecordingError
from urlab_client.protocol.base import Floats

_SCRIPT = Path(__file__).with_name("_lerobot_script.py")
_DEADLINE_S = 600.0
_FRAME_S = 2.0  # which may pass for each frame of an episode besides, while that is encoded
_LOOK_S = 0.02
_ENDING_S = 10.0
_AHEAD = 2  # pending files
_PROBE_S = 120.0
_TOGETHER = 64  # frames per batch
_MOST_FRAMES = 10_000_000  # of an episode
_SLACK = 1.01  # tolerance for rounded times
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
    overwrite: bool = False,
    left_out: Counter[str] | None = None,
    progress: Progress | None = None,
) -> int:
    """Write a LeRobot dataset with LeRobot itself, in an interpreter that has it; return the number of frames.

    A frame is a state and the action taken at it: `observation.state` holds the positions of all articulations,
    `action` the set-points applied from then on, and `observation.images.NAME` the pictures, with dots instead of
    slashes. An episode ends at each reset; its last state, which no action follows, is not a frame. Every 1/fps
    seconds of an episode, starting with its first picture, the newest state and picture become a frame.

    What an environment told is in `next.reward`, the sum of the rewards until the next frame, and in `next.done` and
    `next.success`, as they are then. An episode is done if the environment says so or another one follows.

    Args:
        run: The recording.
        folder: Folder of the dataset.
        python: Interpreter that can import `lerobot` 0.6.
        task: Description of the task.
        fps: Frames per second; by default the rate of the pictures, or of the states if there are none.
        robot_type: Kind of robot; the names of the articulations, joined by `+`, by default.
        cameras: Cameras; by default all recorded ones.
        video: Store pictures as lossy video instead of PNG files.
        max_picture_age: Largest age of a picture relative to its state, seconds; one frame by default.
        episodes: Selection of episodes; see `transitions_of`. Goals are in `observation.environment_state`.
        overwrite: Replace a LeRobot dataset, or an empty folder, once the new dataset is complete.
        left_out: Counts the pairs of states and actions that became no frame, by reason.
        progress: Called occasionally with the number of bytes read so far.

    Raises:
        FileExistsError: The folder exists, and is not to be overwritten or is not a dataset.
        RecordingError: The interpreter has no LeRobot, there is nothing to write, pictures are missing so that a frame
            would show an older state, the rate is not an integer, or LeRobot failed.
        KeyError: The recording has no pictures of a camera.
    """
    _check_folder(folder, overwrite)
    check_episodes(episodes)
    left_out = Counter() if left_out is None else left_out
    _check(python)
    names = run.cameras() if cameras is None else list(cameras)
    steps = iter(phases(run.path.stat().st_size, progress, 1 + 2 * len(names)))
    times = {name: run.picture_times(name, next(steps)) for name in names}
    with (
        run.stored_table(folder.parent, next(steps), fields=("qpos", "set_points")) as table,
        # Beside the dataset, which may be too large for the system's temporary folder.
        tempfile.TemporaryDirectory(prefix=".urlab-", dir=folder.parent, ignore_cleanup_errors=True) as temporary,
    ):
        work, outcomes = Path(temporary), run.outcomes()
        pairs = selected_pairs(table, outcomes, episodes, left_out)
        rate = _rate(run, [*times.values()] or [table.time[pairs.rows]]) if fps is None else fps
        frames = pairs.part(_resampled(run, table, pairs, rate, pictures=[*times.values()], left_out=left_out))
        if not len(frames.rows):
            raise RecordingError(f"{run.path}: it contains nothing for a dataset.")
        episode, when = table.episode[frames.rows], table.time[frames.rows]
        limit = 1 / rate if max_picture_age is None else max_picture_age
        chosen = [_newest(run, name, taken, when, limit) for name, taken in times.items()]
        vectors = _vectors(table, frames.part(np.unique(episode, return_index=True)[1]), outcomes)
        if not np.isfinite(vectors["goal"].values).all():
            raise RecordingError(f"{run.path}: the goals of some of its episodes are unknown.")
        after = _after(run, table, pairs, frames)
        plan = {
            "folder": str((work / "dataset").absolute()),
            "name": folder.name,
            "fps": rate,
            "task": task,
            "robot_type": "+".join(vectors["action"].owners) if robot_type is None else robot_type,
            **{what: vector.names for what, vector in vectors.items()},
            "next": {name: str(values.dtype) for name, values in after.items()},
            "cameras": [name.replace("/", ".") for name in names],
            "video": video,
        }
        (work / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
        pictures = [_Pictures(run, name, video, next(steps)) for name in names]
        with LeRobot(python, work) as writer:
            for part, ends_episode in _batches(episode):
                arrays: dict[str, NDArray[Any]] = {
                    what: vector.values.astype(np.float32)
                    for what, vector in _vectors(table, frames.part(part), outcomes).items()
                }
                arrays |= {name: values[part] for name, values in after.items()}
                for i, (one, which) in enumerate(zip(pictures, chosen, strict=True)):
                    arrays[f"pictures{i}"], arrays[f"picture{i}"] = one.take(which[part])
                writer.add(arrays, ends_episode=ends_episode)
            writer.finish()
        before = work / "replaced"
        try:
            if folder.exists():
                folder.rename(before)
            (work / "dataset").rename(folder)
        except BaseException:
            if before.exists() and not folder.exists():
                before.rename(folder)
            raise
    return len(frames.rows)


def _check_folder(folder: Path, overwrite: bool) -> None:
    if not folder.exists():
        return
    if not overwrite:
        raise FileExistsError(f"{folder} exists, and is replaced only on request")
    if not folder.is_dir() or (any(folder.iterdir()) and not (folder / "meta" / "info.json").is_file()):
        raise FileExistsError(f"{folder} exists and is not a LeRobot dataset, so it is not replaced")


class _Vector(NamedTuple):
    """Columns side by side: the articulations or goals they belong to, their names, and their values."""

    owners: list[str]
    names: list[str]
    values: Floats


def _vectors(table: Table, pairs: Pairs, outcomes: Sequence[OutcomeMessage]) -> dict[str, _Vector]:
    """Return state, action and goal of some pairs."""
    columns = with_goals(pairs_at(table, pairs), outcomes).columns
    chosen: dict[str, dict[str, Column]] = {
        "state": {key.removesuffix("/qpos"): one for key, one in columns.items() if key.endswith("/qpos")},
        "action": {
            key.removesuffix("/action"): one
            for key, one in columns.items()
            if key.endswith("/action") and key.removesuffix("/action") != TASK
        },
        "goal": {key.partition("/")[2]: one for key, one in columns.items() if key.startswith(f"{GOAL}/")},
    }
    return {
        what: _Vector(
            owners=[*found],
            names=[f"{key}.{name}" for key, one in found.items() for name in one.names],
            values=np.concatenate([np.zeros((len(pairs.rows), 0)), *(one.values for one in found.values())], axis=1),
        )
        for what, found in chosen.items()
    }


def _after(run: Run, table: Table, pairs: Pairs, frames: Pairs) -> dict[str, NDArray[Any]]:
    """Return what an environment told about the time from each frame to the next one; nothing if it told nothing."""
    if f"{TASK}/reward" not in table.columns:
        return {}
    # The row that each frame leads to: that of the next frame, or what the last action of the episode led to.
    episode = table.episode[frames.rows]
    final = np.append(np.diff(episode) != 0, True)
    last = pairs.led[np.searchsorted(table.episode[pairs.rows], episode, side="right") - 1]
    until = np.where(final, last, np.append(frames.rows[1:], 0))
    told = {name: table.columns[f"{TASK}/{name}"].values[until, 0] for name in ("reward", "terminated", "truncated")}
    if np.isnan(told["reward"]).all():
        return {}
    if np.isnan(told["reward"][until > frames.rows]).any():  # a frame that is repeated earns nothing
        raise RecordingError(f"{run.path}: the rewards of some of its episodes are unknown.")
    rewards = np.append(np.nan_to_num(table.columns[f"{TASK}/reward"].values[:, 0]), 0.0)
    ends = np.column_stack([frames.rows, until]).ravel() + 1
    found = np.where(until > frames.rows, np.add.reduceat(rewards, ends)[::2], 0.0)
    over = (told["terminated"] + told["truncated"] > 0) | (final & (episode != table.episode[-1]))
    after: dict[str, NDArray[Any]] = {"reward": found.astype(np.float32), "done": over}
    success = table.columns.get(f"{TASK}/success")
    if success is not None and np.isfinite(success.values[until, 0]).all():
        after["success"] = success.values[until, 0] > 0
    return after


def _batches(episodes: NDArray[np.int64]) -> Iterator[tuple[slice, bool]]:
    """Yield consecutive frames of one episode that fit into memory with their pictures, and whether they end it."""
    start = 0
    for end in (*(np.flatnonzero(np.diff(episodes)) + 1).tolist(), len(episodes)):
        while start < end:
            stop = min(start + _TOGETHER, end)
            yield slice(start, stop), stop == end
            start = stop


class _Pictures:
    """The pictures of one camera, read in order as frames need them."""

    def __init__(self, run: Run, camera: str, video: bool, progress: Progress) -> None:
        self._run, self._camera, self._video = run, camera, video
        self._coming = enumerate(run.encoded_pictures(camera, progress))
        self._number = -1
        self._far = 0.0
        self._pixels: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)

    def take(self, numbers: NDArray[np.intp]) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
        """Return pictures, shape (k, H, W, 3), and which of them each of some frames shows."""
        wanted, places = np.unique(numbers, return_inverse=True)
        found = [self._picture(number) for number in wanted.tolist()]
        if any(one.shape != found[0].shape for one in found):
            raise RecordingError(f"{self._run.path}: the pictures of {self._camera} are not all of one size.")
        return np.stack(found), places

    def _picture(self, number: int) -> NDArray[np.uint8]:
        while self._number < number:
            self._number, picture = next(self._coming, (number + 1, None))
            if picture is None:
                break
            if self._number == number or not self._far:
                pixels = picture.pixels()
                self._far = self._far or farthest(pixels)
                shown = visible(pixels, self._far)
                self._pixels = even(shown) if self._video else shown
        if self._number != number:
            raise RecordingError(f"{self._run.path}: some pictures of {self._camera} have disappeared.")
        return self._pixels


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


def _rate(run: Run, times: list[NDArray[np.float64]]) -> int:
    distances = np.concatenate([np.diff(when) for when in times])
    distances = distances[distances > _SLACK_S]
    rate = 1 / float(np.median(distances)) if len(distances) else 0.0
    if round(rate) < 1 or abs(rate - round(rate)) > 0.01 * rate:
        raise RecordingError(
            f"{run.path}: LeRobot needs a whole number of frames per second, but the recording has {rate:.3g}.",
            hint="Name the rate with --fps.",
        )
    return round(rate)


def _resampled(
    run: Run, table: Table, pairs: Pairs, fps: int, *, pictures: list[NDArray[np.float64]], left_out: Counter[str]
) -> NDArray[np.intp]:
    """Return the number of the newest pair at each 1/fps seconds of each episode, from its first pictures on."""
    chosen = [np.zeros(0, dtype=np.intp)]
    time, episodes = table.time[pairs.rows], table.episode[pairs.rows]
    for episode in np.unique(episodes).tolist():
        own = np.flatnonzero(episodes == episode)
        first, last = float(time[own[0]]), float(time[own[-1]])
        began = float(table.time[np.argmax(table.episode == episode)])
        for times in pictures:
            later = times[times >= began - _SLACK_S]
            first = max(first, float(later[0]) if len(later) else np.inf)
        left_out["before the first picture of their episode"] += int((time[own] < first - _SLACK_S).sum())
        if first <= last + _SLACK_S:
            if (last - first) * fps > _MOST_FRAMES:
                raise RecordingError(
                    f"{run.path}: episode {episode} of {last - first:.0f} s has more than {_MOST_FRAMES} frames."
                )
            grid = first + np.arange(int((last - first) * fps + _SLACK_S) + 1) / fps
            found = np.searchsorted(time[own], grid + _SLACK_S, side="right") - 1
            chosen.append(own[np.maximum(found, 0)])
            seen = int((time[own] >= first - _SLACK_S).sum())
            left_out[f"between frames at {fps} per second"] += max(0, seen - len(np.unique(chosen[-1])))
    return np.sort(np.concatenate(chosen))


def _newest(
    run: Run, camera: str, times: NDArray[np.float64], states: NDArray[np.float64], limit: float
) -> NDArray[np.intp]:
    """Return the newest picture at each state."""
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


class LeRobot:
    """Writes one dataset, from files of frames that it deletes one by one. Killed if the block ends before `finish`.

    Args:
        python: The interpreter.
        work: A folder with `plan.json`; see `_lerobot_script`.
    """

    def __init__(self, python: str, work: Path) -> None:
        self._work = work
        self._frames = self._files = 0
        self._pending: deque[Path] = deque()
        with (work / "errors.txt").open("wb") as errors:
            self._process = subprocess.Popen(  # noqa: S603  # the user's own interpreter
                [python, "-P", str(_SCRIPT), str(work)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=errors,
                text=True,
                encoding="utf-8",
                **APART,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._kill()
        self._close_input()

    def add(self, arrays: Mapping[str, NDArray[Any]], *, ends_episode: bool) -> None:
        """Pass on frames, and wait while too many are pending.

        Raises:
            RecordingError: LeRobot failed, or takes too long.
        """
        while len(self._pending) >= _AHEAD:
            self._wait_for_next()
        name = f"{self._files}.npz"
        np.savez(self._work / name, allow_pickle=False, **dict[str, Any](arrays))
        self._files += 1
        self._frames += len(arrays["state"])
        self._pending.append(self._work / name)
        try:
            if self._process.stdin is not None:
                self._process.stdin.write(json.dumps({"file": name, "ends_episode": ends_episode}) + "\n")
                self._process.stdin.flush()
        except OSError:
            raise self._broken_off() from None

    def finish(self) -> None:
        """Wait until the dataset is complete.

        Raises:
            RecordingError: LeRobot failed, or takes too long.
        """
        while self._pending:
            self._wait_for_next()
        self._close_input()
        self._wait(lambda: self._process.poll() is not None)
        if self._process.returncode:
            raise self._broken_off()

    def _wait_for_next(self) -> None:
        file = self._pending.popleft()
        self._wait(lambda: not file.exists())

    def _wait(self, over: Callable[[], bool]) -> None:
        # By looking: its output would stay open as long as encoders of videos that outlive it.
        allowed = _DEADLINE_S + _FRAME_S * self._frames
        until = time.monotonic() + allowed
        while not over():
            if self._process.poll() is not None and not over():
                raise self._broken_off()
            if time.monotonic() > until:
                raise RecordingError(f"LeRobot did not finish within {allowed:g} s.")
            time.sleep(_LOOK_S)

    def _close_input(self) -> None:
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):  # if LeRobot has stopped reading
                self._process.stdin.close()

    def _kill(self) -> None:
        if self._process.poll() is None:
            if sys.platform == "win32":
                self._process.kill()
            else:
                os.killpg(self._process.pid, signal.SIGKILL)  # with the encoders of its videos
            self._process.wait()

    def _broken_off(self) -> RecordingError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDING_S)  # its reason is complete when it has ended
        self._kill()
        said = (self._work / "errors.txt").read_text(encoding="utf-8", errors="replace")
        return RecordingError(f"LeRobot failed: {_last_line(said)}.")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else "it printed nothing"
