"""Recordings as files of other kinds: tables, arrays, videos, LeRobot datasets. Each writes to the path it is given."""

from __future__ import annotations

import csv
import importlib
import json
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from urlab_client.integrations._extras import need
from urlab_client.integrations.record.reader import Camera, Run, Table
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.protocol.pixels import Pixels

__all__ = ["write_csv", "write_lerobot", "write_mp4", "write_npz", "write_parquet"]

Progress = Callable[[int], None]

_TICKS = 90_000  # per second, of MP4 time stamps
_TICK = Fraction(1, _TICKS)
_CODECS = ("libx264", "mpeg4")
_LEROBOT_SCRIPT = Path(__file__).with_name("_lerobot_script.py")
_LEROBOT_DEADLINE_S = 3600.0
_LEROBOT_PROBE_S = 120.0


def write_csv(run: Run, path: Path, progress: Progress | None = None) -> int:
    """Write the states, one column per value; numbers read back to the same bits. Return the number of rows."""
    flat = run.table(progress).flat()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(flat)
        # Python floats: those of NumPy would be written with their type.
        writer.writerows(zip(*(column.tolist() for column in flat.values()), strict=True))
    return len(flat["time"])


def write_npz(run: Run, path: Path, cameras: Sequence[str] = (), progress: Progress | None = None) -> int:
    """Write the states as arrays, `ARTICULATION/FIELD` with names in `ARTICULATION/FIELD.names`; return their number.

    Pictures of the cameras that are named come as `camera/NAME`, shape (n, H, W, channels) or of depth (n, H, W), with
    `camera/NAME.time`. They must fit in memory.
    """
    table = run.table(progress)
    arrays: dict[str, NDArray[Any]] = {
        "time": table.time,
        "sim_time": table.sim_time,
        "wall_ns": table.wall_ns,
        "step": table.step,
        "episode": table.episode,
    }
    for key, column in table.columns.items():
        arrays[key] = column.values
        arrays[f"{key}.names"] = np.array(column.names, dtype=np.str_)
    for name in cameras:
        pictures = list(run.frames(name, progress))
        arrays[f"camera/{name}"] = np.stack([picture.pixels for picture in pictures])
        arrays[f"camera/{name}.time"] = np.array([picture.time for picture in pictures])
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **cast("Any", arrays))
    return len(table)


def write_parquet(run: Run, path: Path, progress: Progress | None = None) -> int:
    """Write the states, one column per value; return the number of rows.

    Raises:
        ImportError: The extra `dataset` is not installed.
    """
    need("pyarrow", extra="dataset")
    pa: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")

    flat = run.table(progress).flat()
    parquet.write_table(pa.table(flat), path, compression="zstd")
    return len(flat["time"])


def write_mp4(run: Run, path: Path, camera: str, progress: Progress | None = None) -> int:
    """Write the pictures of a camera as H.264, each shown at its simulation time; return their number.

    Depth is shown in grey, near bright, black at the farthest depth of the first picture.

    Raises:
        ImportError: The extra `video` is not installed.
        KeyError: There are no pictures of it.
        RecordingError: This PyAV can write no video.
    """
    need("av", extra="video")
    av: Any = importlib.import_module("av")

    codec = next((name for name in _CODECS if name in av.codecs_available), None)
    if codec is None:
        raise RecordingError(f"{path}: this PyAV has neither {' nor '.join(_CODECS)}.")
    count, start, last, far = 0, 0.0, -1, 0.0
    with av.open(str(path), "w", format="mp4") as container:
        stream: Any = container.add_stream(codec, options={"crf": "18"} if codec == "libx264" else {})
        for picture in run.frames(camera, progress):
            if not count:
                start, far = picture.time, _farthest(picture)
                height, width = picture.pixels.shape[:2]
                stream.width, stream.height = width + width % 2, height + height % 2
                stream.pix_fmt = "yuv420p"
                stream.time_base = stream.codec_context.time_base = _TICK
            frame: Any = av.VideoFrame.from_ndarray(_even(_visible(picture.pixels, far)), format="rgb24")
            last = max(last + 1, round((picture.time - start) * _TICKS))
            frame.pts, frame.time_base = last, _TICK
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode())
    return count


def write_lerobot(
    run: Run,
    folder: Path,
    *,
    python: str,
    fps: int,
    task: str,
    cameras: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> int:
    """Write a LeRobot dataset with LeRobot itself, in an interpreter that has it; return the number of frames.

    `observation.state` holds the positions of all articulations, `action` their set-points, and
    `observation.images.NAME` the pictures, with dots for slashes; an episode ends at each reset. At every 1/fps seconds
    the newest state and picture are taken; frames before the first picture are left out.

    Args:
        run: The recording.
        folder: The dataset, which must not exist.
        python: Interpreter that can import `lerobot`.
        fps: Frames per second.
        task: What the robot does, in words.
        cameras: Cameras; all that were recorded by default.
        progress: Told now and then how many bytes have been read.

    Raises:
        FileExistsError: The folder exists.
        RecordingError: The interpreter has no LeRobot, there is nothing to write, or LeRobot failed.
        KeyError: There are no pictures of a camera.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} exists: LeRobot makes the folder itself")
    _check_lerobot(python)
    table = run.table(progress)
    names = run.cameras() if cameras is None else list(cameras)
    with tempfile.TemporaryDirectory(prefix="urlab-lerobot-") as temporary:
        work = Path(temporary)
        times = {name: _save_pictures(run, name, work / str(i), progress) for i, name in enumerate(names)}
        rows = _resampled(table, fps, [when[0] for when in times.values()])
        if not len(rows):
            raise RecordingError(f"{run.path}: there is nothing to make a dataset of.")
        state, action = (_joined(table, field) for field in ("qpos", "set_points"))
        arrays: dict[str, Any] = {
            "state": state[1][rows].astype(np.float32),
            "action": action[1][rows].astype(np.float32),
            "episode": table.episode[rows],
        }
        for i, when in enumerate(times.values()):
            arrays[f"picture{i}"] = np.searchsorted(when, table.time[rows] + 1e-9, side="right") - 1
        np.savez(work / "states.npz", allow_pickle=False, **arrays)
        plan = {
            "folder": str(folder.absolute()),
            "fps": fps,
            "task": task,
            "state": state[0],
            "action": action[0],
            "cameras": [name.replace("/", ".") for name in names],
        }
        (work / "plan.json").write_text(json.dumps(plan), encoding="utf-8")
        _run_lerobot(python, work)
    return len(rows)


def _check_lerobot(python: str) -> None:
    try:
        done = subprocess.run(  # noqa: S603  # the user's own interpreter
            [python, "-c", "import lerobot"], capture_output=True, text=True, timeout=_LEROBOT_PROBE_S, check=False
        )
    except OSError as error:
        raise RecordingError(f"{python} cannot be run: {error.strerror}.", hint="Name a Python interpreter.") from error
    except subprocess.TimeoutExpired:
        raise RecordingError(f"{python} did not import lerobot within {_LEROBOT_PROBE_S:g} s.") from None
    if done.returncode:
        raise RecordingError(
            f"{python} has no LeRobot: {_last_line(done.stderr)}.",
            hint="Make an environment for it (pip install lerobot) and name its interpreter with --python.",
        )


def _run_lerobot(python: str, work: Path) -> None:
    try:
        done = subprocess.run(  # noqa: S603  # the user's own interpreter
            [python, str(_LEROBOT_SCRIPT), str(work)],
            capture_output=True,
            text=True,
            timeout=_LEROBOT_DEADLINE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise RecordingError(f"LeRobot did not finish within {_LEROBOT_DEADLINE_S:g} s.") from None
    if done.returncode:
        raise RecordingError(f"LeRobot failed: {_last_line(done.stderr)}.")


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _save_pictures(run: Run, camera: str, folder: Path, progress: Progress | None) -> NDArray[np.float64]:
    folder.mkdir()
    times: list[float] = []
    far = 0.0
    for i, picture in enumerate(run.frames(camera, progress)):
        far = far or _farthest(picture)
        Image.fromarray(_visible(picture.pixels, far)).save(folder / f"{i}.png", compress_level=1)
        times.append(picture.time)
    return np.array(times)


def _resampled(table: Table, fps: int, starts: list[float]) -> NDArray[np.intp]:
    """Return the row of the newest state at each 1/fps seconds of each episode."""
    rows: list[NDArray[np.intp]] = []
    for episode in np.unique(table.episode).tolist():
        own = np.flatnonzero(table.episode == episode)
        first = max([float(table.time[own[0]]), *starts])
        last = float(table.time[own[-1]])
        if first <= last:
            grid = first + np.arange(int((last - first) * fps + 1e-6) + 1) / fps
            found = np.searchsorted(table.time[own], grid + 1e-9, side="right") - 1
            rows.append(own[np.maximum(found, 0)])
    return np.concatenate(rows) if rows else np.zeros(0, dtype=np.intp)


def _joined(table: Table, field: str) -> tuple[list[str], NDArray[np.float64]]:
    chosen = {key: column for key, column in table.columns.items() if key.endswith(f"/{field}")}
    names = [f"{key.rpartition('/')[0]}.{name}" for key, column in chosen.items() for name in column.names]
    values = [column.values for column in chosen.values()]
    return names, np.concatenate(values, axis=1) if values else np.zeros((len(table), 0))


def _farthest(picture: Camera) -> float:
    depths = picture.pixels[np.isfinite(picture.pixels)] if picture.pixels.dtype == np.float32 else np.zeros(0)
    return float(depths.max()) if depths.size else 1.0


def _visible(pixels: Pixels, far: float) -> NDArray[np.uint8]:
    """Return pixels as RGB."""
    if pixels.dtype == np.float32:
        grey = np.clip(1.0 - np.nan_to_num(pixels, nan=far, posinf=far) / far, 0.0, 1.0)
        return np.repeat(np.rint(255 * grey).astype(np.uint8)[..., None], 3, axis=2)
    return np.ascontiguousarray(pixels[..., :3], dtype=np.uint8)


def _even(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repeat the last row and column where their number is odd, which H.264 refuses."""
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge") if height % 2 or width % 2 else pixels
