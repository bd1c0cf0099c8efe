"""Recordings as files of other kinds: tables, arrays, videos, LeRobot datasets. Each writes to the path it is given.

Tables are pairs of an observation and the action taken at it, see `transitions`; arrays are the states as recorded.
"""

from __future__ import annotations

import csv
import importlib
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from urlab_client._extras import need
from urlab_client.integrations.record.lerobot_writer import write_lerobot
from urlab_client.integrations.record.pixels import even, farthest, visible
from urlab_client.integrations.record.reader import Run
from urlab_client.integrations.record.transitions import Episodes, transitions_of
from urlab_client.integrations.record.writer import RecordingError

__all__ = ["write_csv", "write_lerobot", "write_mp4", "write_npz", "write_parquet"]

Progress = Callable[[int], None]

_TICKS = 90_000  # per second, of MP4 time stamps
_TICK = Fraction(1, _TICKS)
_ROWS = 10_000
_CODECS = ("libx264", "mpeg4")


def write_csv(run: Run, path: Path, progress: Progress | None = None, *, episodes: Episodes = "kept") -> int:
    """Write observations and the actions taken at them, one column per value; return the number of rows.

    Numbers read back to the same bits. See `transitions` for what is a row, and `transitions_of` for `episodes`.
    """
    flat = transitions_of(run, only=episodes, progress=progress).flat()
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(flat)
        # Python floats: those of NumPy would be written with their type. They take more room, so some at a time.
        for start in range(0, len(flat["time"]), _ROWS):
            rows = slice(start, start + _ROWS)
            writer.writerows(zip(*(column[rows].tolist() for column in flat.values()), strict=True))
    return len(flat["time"])


def write_npz(run: Run, path: Path, cameras: Sequence[str] = (), progress: Progress | None = None) -> int:
    """Write all states, as they were recorded, and return their number.

    Arrays are called `ARTICULATION/FIELD`, and the names of their values are in `ARTICULATION/FIELD.names`.
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


def write_parquet(run: Run, path: Path, progress: Progress | None = None, *, episodes: Episodes = "kept") -> int:
    """Write observations and the actions taken at them, one column per value; return the number of rows.

    See `transitions` for what is a row, and `transitions_of` for `episodes`.

    Raises:
        ImportError: The extra `dataset` is not installed.
    """
    need("pyarrow", extra="dataset")
    pa: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")

    flat = transitions_of(run, only=episodes, progress=progress).flat()
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
                start, far = picture.time, farthest(picture.pixels)
                height, width = picture.pixels.shape[:2]
                stream.width, stream.height = width + width % 2, height + height % 2
                stream.pix_fmt = "yuv420p"
                stream.time_base = stream.codec_context.time_base = _TICK
            frame: Any = av.VideoFrame.from_ndarray(even(visible(picture.pixels, far)), format="rgb24")
            last = max(last + 1, round((picture.time - start) * _TICKS))
            frame.pts, frame.time_base = last, _TICK
            container.mux(stream.encode(frame))
            count += 1
        container.mux(stream.encode())
    return count
