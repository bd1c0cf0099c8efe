"""Recordings that need not fit in memory: tables in pieces, conversions of them, and conversions that break off."""

from __future__ import annotations

import contextlib
import os
import signal
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet
import pytest
from children import in_background
from made_recordings import Robot, write_recording

from urlab_client._platform.files import replaced
from urlab_client.cli import main
from urlab_client.integrations.record import Run, export, read_run, tables
from urlab_client.integrations.record.transitions import transitions_of


def changing(count: int) -> Iterator[tuple[dict[str, Robot], dict[str, list[float]]]]:
    """States of a scene in which a robot and an entity come later, and a sensor gets wider in between."""
    for i in range(count):
        readings = {"touch": [0.5] if i < 37 else [0.5, float(i)]}
        late = {"late": Robot([i / 3, 1.0])} if i > 31 and i % 7 else {}
        yield {"arm": Robot([i / 7], readings), **late}, {"box": [float(i), 0.0, 0.0]} if i > 41 else {}


def test_the_state_of_a_moment_has_what_was_in_the_scene_then(tmp_path: Path) -> None:
    write_recording(tmp_path / "run.mcap", changing(60))
    run = read_run(tmp_path / "run.mcap")
    early, late = run.state_at(0.2), run.state_at(0.5)
    assert early is not None
    assert late is not None
    assert (early.articulations.keys(), early.entities) == ({"arm"}, {})
    assert late.articulations["late"].qpos.tolist() == [50 / 3, 1.0]
    assert late.articulations["arm"].sensors["touch"].tolist() == [0.5, 50.0]
    assert late.entities["box"].position.tolist() == [50.0, 0.0, 0.0]
    without = run.state_at(0.49)
    assert without is not None
    assert without.articulations.keys() == {"arm"}, "it has left for this sample"
    assert without.entities["box"].position.tolist() == [49.0, 0.0, 0.0]


def steady(count: int) -> Iterator[tuple[dict[str, Robot], dict[str, list[float]]]]:
    return (({"arm": Robot([float(i)] * 20)}, {}) for i in range(count))


def test_pieces_make_the_whole_table_also_when_columns_come_late_or_the_end_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, made = tmp_path / "run.mcap", tmp_path / "made" / "run.parquet"
    made.parent.mkdir()
    write_recording(file, changing(70), episode_length=20, chunk_size=350)
    partial = set[bool]()
    size = file.stat().st_size
    (messages_end,) = struct.unpack("<Q", file.read_bytes()[-28:-20])
    for end in (size, *range(messages_end - 50, messages_end - 1000, -200)):
        os.truncate(file, end)
        run = read_run(file)
        monkeypatch.setattr(tables, "PIECE_VALUES", 1 << 21)
        whole, pairs = run.table(), transitions_of(run)
        partial.add(len(whole) < run.summary().topics["/state/arm"].messages)
        assert {"arm/sensors", "late/qpos", "box/pose"} <= whole.columns.keys()
        for values in (1, 150):
            monkeypatch.setattr(tables, "PIECE_VALUES", values)
            with run.stored_table(tmp_path) as stored:
                for found in (stored, run.table()):
                    assert found.columns.keys() == whole.columns.keys()
                    for name, expected in whole.arrays().items():
                        assert found.arrays()[name].tobytes() == expected.tobytes()
                    assert [(one.names, one.quantities) for one in found.columns.values()] == [
                        (one.names, one.quantities) for one in whole.columns.values()
                    ]
            assert export.write_parquet(run, made) == len(pairs)
            read = parquet.read_table(made)
            assert parquet.ParquetFile(made).num_row_groups > 5
            for name, expected in pairs.flat().items():
                assert read[name].to_numpy().tobytes() == expected.tobytes()
    assert partial == {False, True}, "some of the files end in the middle of a state"
    assert sorted(os.listdir(tmp_path)) == ["made", file.name]
    assert os.listdir(made.parent) == [made.name]


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_a_long_recording_is_converted_in_the_memory_of_a_short_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(tables, "PIECE_VALUES", 2000)
    file, write = tmp_path / "run.mcap", getattr(export, f"write_{kind}")
    peaks: list[int] = []
    for count in (200, 200, 1600):  # the first time imports what the conversion needs
        write_recording(file, steady(count), episode_length=10**6, chunk_size=20_000)
        run = read_run(file)
        tracemalloc.start()
        try:
            write(run, tmp_path / f"run.{kind}")
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    _, short, long = peaks
    assert long - short < 1400 * 40 * 8 / 2, "half of what the values of the other states take"


@pytest.mark.parametrize("kind", ["csv", "npz", "parquet"])
def test_a_conversion_that_breaks_off_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(tables, "PIECE_VALUES", 500)
    source, folder = tmp_path / "run.mcap", tmp_path / "made"
    folder.mkdir()
    write_recording(source, steady(100), chunk_size=5000)
    run, target, write = read_run(source), folder / f"run.{kind}", getattr(export, f"write_{kind}")
    told: list[int] = []
    write(run, target, progress=told.append)
    assert told == sorted(told)
    assert source.stat().st_size / 2 < max(told) <= source.stat().st_size
    target.write_bytes(b"precious")
    for limit in (1, (len(told) + 1) // 2, len(told)):
        with pytest.raises(KeyboardInterrupt):
            write(run, target, progress=interrupting(limit))
        assert os.listdir(folder) == [target.name]
        assert target.read_bytes() == b"precious"


def interrupting(limit: int) -> Any:
    """Return what presses Ctrl-C when it is told for the last of some times."""
    left = iter(range(limit - 1))

    def progress(_: int) -> None:
        if next(left, None) is None:
            signal.raise_signal(signal.SIGINT)

    return progress


@pytest.mark.parametrize("job", [contextlib.nullcontext, in_background], ids=["in a terminal", "in the background"])
def test_a_conversion_that_is_terminated_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, job: Callable[[], contextlib.AbstractContextManager[None]]
) -> None:
    write_recording(tmp_path / "run.mcap", steady(10))

    def half(_run: Run, path: Path, *_: Any, **__: Any) -> int:
        with replaced(path) as temporary:
            temporary.write_text("half", encoding="utf-8")
            signal.raise_signal(signal.SIGTERM)
        return 0

    monkeypatch.setattr(export, "write_csv", half)
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # where it is not heeded the file is made
    try:
        with job():
            assert main(["convert", str(tmp_path / "run.mcap"), str(tmp_path / "run.csv")]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert os.listdir(tmp_path) == ["run.mcap"]
