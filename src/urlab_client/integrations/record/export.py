"""Conversion of recordings to tables, arrays, videos and LeRobot datasets. Output files appear only when complete.

Tables contain pairs of an observation and the action taken at it, see `transitions`; arrays contain the states as
recorded. Memory holds only a part of the recording; a temporary file beside the output holds the whole, with 8 bytes
for each value of each state. An exception from `progress` aborts a conversion.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import zipfile
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client._platform.files import replaced
from urlab_client.integrations.record import tables
from urlab_client.integrations.record.contents import Table, even, farthest, visible
from urlab_client.integrations.record.index import Progress
from urlab_client.integrations.record.lerobot import write_lerobot
from urlab_client.integrations.record.reader import Run, phases
from urlab_client.integrations.record.transitions import Episodes, check_episodes, pairs_at, selected_pairs, with_goals
from urlab_client.integrations.record.writer import RecordingError

__all__ = ["write_csv", "write_lerobot", "write_mp4", "write_npz", "write_parquet"]

_ROWS = 1_000
_NAMES_CHARS = 32 << 20
_CODECS = {"libx264": 90_000, "mpeg4": 60_000}
"""Ticks per second of MP4 timestamps by codec; MPEG-4 allows at most 65,535."""


def write_csv(
    run: Run,
    path: Path,
    progress: Progress | None = None,
    *,
    episodes: Episodes = "kept",
    left_out: Counter[str] | None = None,
) -> int:
    """Write observations and the actions taken at them, one column per value; return the number of rows.

    Numbers are written without loss of precision. See `transitions` for the rows, and `transitions_of` for `episodes`.
    The number of pairs that are not written is counted in `left_out`, by reason.
    """
    count = 0
    with (
        replaced(path) as temporary,
        contextlib.closing(_transitions(run, path.parent, episodes, left_out, progress)) as pieces,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        for number, piece in enumerate(pieces):
            flat = piece.flat()
            if not number:
                writer.writerow(flat)
            # Converted to Python floats, because NumPy's would be written with their type; in blocks, because they
            # take more memory.
            for start in range(0, len(piece), _ROWS):
                rows = slice(start, start + _ROWS)
                writer.writerows(zip(*(column[rows].tolist() for column in flat.values()), strict=True))
            count += len(piece)
    return count


def write_npz(run: Run, path: Path, cameras: Sequence[str] = (), progress: Progress | None = None) -> int:
    """Write all states as recorded, and return their number.

    Arrays are called `ARTICULATION/FIELD`, and the names of their values `ARTICULATION/FIELD.names`. Pictures of the
    given cameras are `camera/NAME`, shape (n, H, W, channels), or (n, H, W) for depth, with their times in
    `camera/NAME.time`.

    Raises:
        KeyError: The recording has no pictures of a camera.
        RecordingError: The pictures of a camera differ in size.
    """
    size = run.path.stat().st_size
    steps = iter(phases(size, progress, 2 + 2 * len(cameras)))
    times = {name: run.picture_times(name, next(steps)) for name in cameras}
    with (
        replaced(path) as temporary,
        run.stored_table(path.parent, next(steps)) as table,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        writing = next(steps)
        _save_table(run, archive, table, lambda share: writing(int(share * size)))
        for name, when in times.items():
            pictures = (picture.pixels[None] for picture in islice(run.frames(name, next(steps)), len(when)))
            try:
                _save(archive, f"camera/{name}", pictures, len(when))
            except ValueError as error:
                raise RecordingError(f"{run.path}: the pictures of {name} do not fit one array: {error}.") from None
            _save(archive, f"camera/{name}.time", [when], len(when))
        return len(table)


def write_parquet(
    run: Run,
    path: Path,
    progress: Progress | None = None,
    *,
    episodes: Episodes = "kept",
    left_out: Counter[str] | None = None,
) -> int:
    """Write observations and the actions taken at them, one column per value; return the number of rows.

    See `write_csv`.

    Raises:
        ImportError: The extra `dataset` is not installed.
    """
    need("pyarrow", extra="dataset")
    pa: Any = importlib.import_module("pyarrow")
    parquet: Any = importlib.import_module("pyarrow.parquet")

    count = 0
    with (
        replaced(path) as temporary,
        contextlib.closing(_transitions(run, path.parent, episodes, left_out, progress)) as pieces,
        contextlib.ExitStack() as stack,
    ):
        writer: Any = None
        for piece in pieces:
            group = pa.table(piece.flat())
            if writer is None:
                # Without dictionaries, because numbers hardly repeat.
                options = {"compression": "zstd", "use_dictionary": False}
                writer = stack.enter_context(parquet.ParquetWriter(temporary, group.schema, **options))
            if len(piece):
                writer.write_table(group)
            count += len(piece)
    return count


def write_mp4(run: Run, path: Path, camera: str, progress: Progress | None = None) -> int:
    """Write the pictures of a camera as H.264, each shown at its simulation time; return their number.

    Depth is shown in grey, from bright (near) to black (the largest depth of the first picture).

    Raises:
        ImportError: The extra `video` is not installed.
        KeyError: The recording has no pictures of the camera.
        RecordingError: The installed PyAV cannot write video, or not of these pictures.
    """
    need("av", extra="video")
    av: Any = importlib.import_module("av")

    codec = next((name for name in _CODECS if name in av.codecs_available), None)
    if codec is None:
        raise RecordingError(f"{path}: this PyAV has neither {' nor '.join(_CODECS)}.")
    ticks, count, start, last, far, height, width = _CODECS[codec], 0, 0.0, -1, 0.0, 0, 0
    try:
        with replaced(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
            stream: Any = container.add_stream(codec, options={"crf": "18"} if codec == "libx264" else {})
            for picture in run.frames(camera, progress):
                if not count:
                    start, far = picture.time, farthest(picture.pixels)
                    height, width = picture.pixels.shape[:2]
                    stream.width, stream.height = width + width % 2, height + height % 2
                    stream.pix_fmt = "yuv420p"
                    stream.time_base = stream.codec_context.time_base = Fraction(1, ticks)
                if picture.pixels.shape[:2] != (height, width):
                    raise RecordingError(f"{run.path}: the pictures of {camera} are not all of one size.")
                frame: Any = av.VideoFrame.from_ndarray(even(visible(picture.pixels, far)), format="rgb24")
                last = max(last + 1, round((picture.time - start) * ticks))
                frame.pts, frame.time_base = last, Fraction(1, ticks)
                container.mux(stream.encode(frame))
                count += 1
            container.mux(stream.encode())
    except av.FFmpegError as error:
        raise RecordingError(f"{run.path}: the pictures of {camera} cannot be written as video: {error}.") from error
    return count


def _transitions(
    run: Run, folder: Path, episodes: Episodes, left_out: Counter[str] | None, progress: Progress | None
) -> Generator[Table]:
    """Yield the pairs of a recording in pieces, each of which counts as written when the next one is taken."""
    check_episodes(episodes)
    size = run.path.stat().st_size
    reading, writing = phases(size, progress, 2)
    with run.stored_table(folder, reading) as table:
        outcomes = run.outcomes()
        pairs = selected_pairs(table, outcomes, episodes, left_out)
        total, width = len(pairs.rows), sum(column.values.shape[1] for column in table.columns.values()) + 1
        count = 0
        for part in np.array_split(np.arange(total), 1 + total * width // tables.PIECE_VALUES):
            yield with_goals(pairs_at(table, pairs.part(part)), outcomes)
            count += len(part)
            writing(size * count // max(1, total))


def _save_table(run: Run, archive: zipfile.ZipFile, table: Table, report: Callable[[float], None]) -> None:
    arrays = table.arrays()
    for number, (name, values) in enumerate(arrays.items()):
        parts = np.array_split(values, 1 + values.size // tables.PIECE_VALUES)
        _save(archive, name, parts, len(table), lambda: report(number / len(arrays)))  # noqa: B023
        column = table.columns.get(name)
        if column is not None:
            if len(column.names) * max(map(len, column.names)) > _NAMES_CHARS:  # each takes the space of the longest
                raise RecordingError(f"{run.path}: the names of the values of {name} are too long for an array.")
            _save(archive, f"{name}.names", [np.array(column.names, dtype=np.str_)], len(column.names))


def _save(
    archive: zipfile.ZipFile,
    name: str,
    parts: Iterable[NDArray[Any]],
    count: int,
    report: Callable[[], None] = lambda: None,
) -> None:
    """Add an array of `count` rows to an archive like `numpy.savez`, with only a part of it in memory."""
    rows, form = 0, None
    with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
        for part in parts:
            report()
            if form is None:
                form = part.shape[1:], part.dtype
                descr = np.lib.format.dtype_to_descr(part.dtype)
                header = {"descr": descr, "fortran_order": False, "shape": (count, *part.shape[1:])}
                np.lib.format.write_array_header_1_0(entry, header)
            elif (part.shape[1:], part.dtype) != form:
                raise ValueError(f"one has shape {part.shape[1:]}, another {form[0]}")
            entry.write(part.tobytes())
            rows += len(part)
    if rows != count or form is None:
        raise ValueError(f"{rows} of {count} can be read")
