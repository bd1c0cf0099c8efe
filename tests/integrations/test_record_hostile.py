"""Recordings that somebody else wrote: each entry point reads them or names what is wrong, in bounded memory."""

from __future__ import annotations

import io
import json
import math
import random
import re
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from made_recordings import Message
from made_recordings import messages_of as messages
from made_recordings import write_messages as write
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType
from PIL import Image

import urlab_client
from urlab_client.cli import main
from urlab_client.console.messages import state_message
from urlab_client.console.pictures import _jpeg_of
from urlab_client.console.recordings import _described
from urlab_client.console.replay import _opened, _present, _Robot
from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    CompressedImage,
    EpisodeMessage,
    GapMessage,
    OutcomeMessage,
    RawImage,
    Time,
    encode,
    schema_name,
)
from urlab_client.integrations.record import (
    RecordingError,
    Run,
    export,
    index,
    read_run,
    reader,
    record,
)
from urlab_client.randomise import Randomisation
from urlab_client.server import SimulatedServer
from urlab_client.simulation import joint_recording as recording

STATE = schema_name(ArticulationMessage)
MIB = 1 << 20
ZERO = Time(0, 0)
STAMP = {"sec": 0, "nsec": 0}


def state(at: int = 0, **changes: Any) -> Message:
    """A state of an arm with one joint, with some fields changed."""
    numbers = {"sim_time": at / 100, "sample": at, "step": at, "episode": 0}
    stamps = {"timestamp": STAMP, "wall_time": STAMP}
    fields: dict[str, Any] = {**numbers, **stamps, "qpos": [0.5], "qvel": [0.0], "set_points": [0.5], **changes}
    return Message("/state/arm", STATE, at * 10**7, json.dumps(fields).encode(), {})


def picture(data: bytes, kind: str = "png", /, **changes: Any) -> Message:
    message = encode(CompressedImage(ZERO, "arm/eye", data, kind))
    return Message(
        "/camera/arm/eye", schema_name(CompressedImage), 0, json.dumps(json.loads(message) | changes).encode(), {}
    )


def depths(**changes: Any) -> Message:
    message = json.loads(encode(RawImage(ZERO, "arm/eye", 4, 2, "32FC1", 16, np.ones(8, "<f4").tobytes())))
    kind = schema_name(RawImage)
    return Message("/camera/arm/eye", kind, 0, json.dumps(message | changes).encode(), {"mode": "depth"})


def png(width: int, height: int, mode: str = "RGB", colour: Any = 0) -> bytes:
    file = io.BytesIO()
    Image.new(mode, (width, height), colour).save(file, "PNG")
    return file.getvalue()


# Every entry point


def uses(path: Path, folder: Path) -> Iterator[Callable[[Run], Any]]:
    """Everything that is done with a recording."""
    yield lambda run: run.summary()
    yield lambda run: run.summary(verify=True)
    yield lambda run: run.table()
    yield lambda run: run.outcomes()
    yield lambda run: run.positions()
    for time in (-math.inf, -1.0, 0.0, 0.02, 1e300, math.inf):
        yield lambda run, time=time: run.state_at(time)
        yield lambda run, time=time: [run.picture_at(name, time) for name in run.cameras()]
        yield lambda run, time=time: [run.encoded_picture_at(name, time) for name in run.cameras()]
    yield lambda run: [(run.picture_times(name), [*run.frames(name)]) for name in run.cameras()]
    yield lambda run: export.write_csv(run, folder / "made.csv")
    yield lambda run: export.write_parquet(run, folder / "made.parquet")
    yield lambda run: export.write_npz(run, folder / "made.npz", run.cameras())
    yield lambda run: [export.write_mp4(run, folder / "made.mp4", name) for name in run.cameras()]
    yield lambda _: _described(path)
    yield lambda _: replayed(path)


def replayed(path: Path) -> None:
    """What the console does with a recording."""
    run, (start, end), names, _, cameras = _opened(path)
    robots = {key: _Robot(key, len(own)) for key, own in names.items()}
    for time in np.linspace(start, end, 5).tolist():
        found = run.state_at(time)
        if found is not None:
            json.dumps(state_message(0, found.snapshot(found.time - start, _present(found, robots)), {}), default=str)
        for name in cameras:
            _jpeg_of(run.encoded_picture_at(name.removeprefix("-/"), time))


def complaints(path: Path, folder: Path) -> list[str]:
    """Use a recording in every way, and return the errors, which must be those of recordings."""
    found: list[str] = []
    for use in uses(path, folder):
        try:
            use(read_run(path))
        except RecordingError as error:
            found.append(str(error))
    assert all(path.name in one for one in found)
    for command in (["info", str(path), "--json"], ["info", str(path), "--verify"]):
        assert main(command) in {0, 1, 2}
    return found


# Contents


@pytest.fixture(scope="module")
def good(opengl: None, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Recordings of both dialects: states, colours, depths, episodes that vary, and their outcomes."""
    folder = tmp_path_factory.mktemp("good")
    found: list[Path] = []
    for dialect, mode in (("alpha", "depth"), ("beta", "real")):
        varied = Randomisation.from_json('{"vary": [{"what": "mass", "scale": [0.9, 1.1]}]}')
        with (
            SimulatedServer(
                "arm",
                play=True,
                dialect=dialect,
                camera_size=(8, 6),
                camera_modes={"arm/wrist": mode},
                randomise=varied,
            ) as server,
            urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
        ):
            client.discover()
            with record(client, folder / f"{dialect}.mcap", cameras=["arm/wrist"], camera_hz=500) as recorder:
                for seed in range(2):
                    client.reset(seed=seed)
                    for _ in range(3):
                        client.step()
                    recorder.mark("success", goal={"place": [0.5, 0.5]})
        found.append(recorder.path)
        schemas = {one.schema for one in messages(recorder.path)}
        assert {schema_name(kind) for kind in (ArticulationMessage, EpisodeMessage, OutcomeMessage)} <= schemas
    return found


def test_good_recordings_are_used_without_complaint(good: list[Path], tmp_path: Path) -> None:
    for path in good:
        assert complaints(write(tmp_path / path.name, messages(path)), tmp_path) == []


ODD: list[Any] = [
    None, True, "", "NaN", "Infinity", "x", [], [[]], {}, {"a": 1}, -1, 0, 1.5, 1e300, -(2**63), 2**63, 2**64, 10**400,
    [1.0] * 40, ["NaN"] * 3, [None], "\0", "é" * 300,
]  # fmt: skip
ODD_TIMES = (0, 1, 2**63 - 1, 2**63, 2**64 - 1)


def places(node: Any) -> list[tuple[Any, Any]]:
    """Container and key of every value in a message."""
    keys = [*node] if isinstance(node, dict) else [*range(len(node))] if isinstance(node, list) else []
    return [(node, key) for key in keys] + [place for key in keys for place in places(node[key])]


def mutated(content: list[Message], draw: random.Random) -> list[Message]:
    """Change one message, so that the file is still well-formed."""
    content = list(content)
    at = draw.randrange(len(content))
    one = content[at]
    match draw.choice(("value", "value", "value", "missing", "data", "time", "schema", "topic", "layout", "order")):
        case "value" | "missing" as kind:
            try:
                fields = json.loads(one.data)
            except ValueError:  # changed already
                return content
            if not places(fields):
                return content
            container, key = draw.choice(places(fields))
            if kind == "value":
                container[key] = draw.choice(ODD)
            else:
                del container[key]
            one = one._replace(data=json.dumps(fields).encode())
        case "data":
            odd = [b"", b"{", b"\xff", b"[" * 10**5, b"null", draw.choice(content).data, one.data[: draw.randrange(50)]]
            one = one._replace(data=draw.choice(odd))
        case "time":
            one = one._replace(time=draw.choice(ODD_TIMES), publish_time=draw.choice(ODD_TIMES))
        case "schema":
            one = one._replace(schema=draw.choice(content).schema)
        case "topic":
            one = one._replace(
                topic=draw.choice(("", "/", "/state/", "/camera/", "/state/a\0b", "[/b]", "/state/" + "x" * 70_000))
            )
        case "layout":
            text = json.dumps(draw.choice(ODD)), '{"qpos": 3}', '{"qpos": ["$a$_", "b"]}', "[" * 10**5
            one = one._replace(metadata={"layout": draw.choice(text)})
        case _:
            draw.shuffle(content)
            return content
    content[at] = one
    return content


@given(seed=st.integers(0, 2**32))
@settings(phases=[Phase.explicit, Phase.generate])  # a smaller seed is no simpler
def test_changed_recordings_are_read_or_refused(
    good: list[Path], tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    draw, folder = random.Random(seed), tmp_path_factory.mktemp("changed")
    content = messages(draw.choice(good))
    for _ in range(draw.randint(1, 3)):
        content = mutated(content, draw)
    options: dict[str, Any] = {}
    if damaged := draw.random() < 0.3:  # where no checksum tells
        options = {"enable_crcs": False, "compression": draw.choice([*CompressionType])}
    path = write(folder / "changed.mcap", content, **options)
    if damaged:
        data = bytearray(path.read_bytes())
        for _ in range(draw.randint(1, 5)):
            data[draw.randrange(len(data))] = draw.randrange(256)
        path.write_bytes(data)
    complaints(path, folder)


@pytest.mark.parametrize(
    ("content", "message", "problem"),
    [
        ([state(), state(1, step="one")], 2, "Expected `int`, got `str`"),
        ([state(step=-1)], 1, "Expected `int` >= 0"),
        ([state(sample=2**63)], 1, "Expected `int` <="),
        ([state(episode="NaN")], 1, "Expected `int`, got `str`"),
        ([state(), state()._replace(data=b"{")], 2, "truncated"),
        ([state()._replace(data=b'{"a": ' + b"[" * 10**5)], 1, "recursion"),
        ([state()._replace(data=b'{"sensors": {"\xff": []}}')], 1, "utf-8"),
        ([state()._replace(data=b"{}")], 1, "missing required field"),
        ([state(1), state(0)], 2, "sample 0 comes after sample 1"),
        ([state(), state()], 2, "sample 0 comes after sample 0"),
        ([state(), state(1)._replace(schema=schema_name(EpisodeMessage))], 1, "missing required field"),
        ([picture(png(4, 4), data=3)], 1, "Expected `bytes`, got `int`"),
        ([picture(png(4, 4)), picture(b"no picture")], 2, "cannot identify image file"),
        ([picture(png(40, 40)[:-30])], 1, "truncated"),
        ([depths(), depths(width=5)], 2, "32 bytes of '32FC1' in rows of 16 bytes are not 5x2 depths"),
        ([depths(step=8)], 1, "in rows of 8 bytes"),
        ([depths(encoding="rgb8")], 1, "32 bytes of 'rgb8'"),
        ([depths(width=0, height=0, step=0, data="")], 1, "0x0 pixels"),
        ([depths(width=-4)], 1, "Expected `int` >= 0"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_wrong_is_named(content: list[Message], message: int, problem: str, tmp_path: Path) -> None:
    path = write(tmp_path / "wrong.mcap", content)
    found = complaints(path, tmp_path)
    assert any(problem in one and f"message {message} of {content[-1].topic} cannot be read" in one for one in found)
    assert len(found) < len([*uses(path, tmp_path)]), "the rest of the file is there"


def other(kind: type[Any], **fields: Any) -> Message:
    return Message(f"/recording/{kind.__name__}", schema_name(kind), 0, json.dumps(fields).encode(), {})


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ([state(), state(1)._replace(time=2**63)], "a time of"),
        ([state(), depths()._replace(time=2**64 - 1)], "a message of /camera/arm/eye has a time of more than"),
        ([state(), state(1)._replace(publish_time=2**64 - 1)], "a time of"),
        ([state()._replace(metadata={"layout": "3"})], "the layout of /state/arm cannot be read: Expected `object`"),
        ([state()._replace(metadata={"layout": '{"x": ' + "[" * 10**5})], "the layout of /state/arm cannot be read"),
        ([state()._replace(topic="/state/" + "x" * 70_000)], "is not a valid name of a channel"),
        ([state()._replace(topic="/state/a\0b")], "is not a valid name of a channel"),
        ([picture(png(8, 8)), picture(png(4, 6))], "not all of one size"),
        ([picture(png(20_000, 2))], "cannot be written as video"),
        ([other(GapMessage, timestamp=STAMP, states="many", frames=0)], "Expected `int`, got `str`"),
        ([other(OutcomeMessage, timestamp=STAMP, episode=0, outcome="won", goal={})], "Invalid enum value"),
        ([other(EpisodeMessage, timestamp=STAMP, episode=0, seed=2**64, varied=[])], "Expected `int` <="),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_cannot_be_used_is_refused(content: list[Message], problem: str, tmp_path: Path) -> None:
    assert any(problem in one for one in complaints(write(tmp_path / "wrong.mcap", content), tmp_path))


def test_what_is_only_odd_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drawn = {"what": "mass", "by": "scale", "drawn": {"arm": []}}
    goals = [{"a": [1.0]}, {"a": [1.0, 2.0, 3.0]}, {}, {"a": [4.0, 5.0]}]
    marks = [
        other(OutcomeMessage, timestamp=STAMP, episode=number, outcome="success", goal=goal)
        for number, goal in enumerate(goals)
    ]
    content = [
        *(state(at, episode=at // 2) for at in range(2 * len(goals))),
        state(7)._replace(topic="/state/[/b] :smile:"),
        picture(b"no camera")._replace(topic="/eye"),
        other(EpisodeMessage, timestamp=STAMP, episode=0, seed=1, varied=[drawn]),
        *marks,
    ]
    path = write(tmp_path / "odd.mcap", content)
    assert complaints(path, tmp_path) == []
    assert "/state/[/b] :smile:" in capsys.readouterr().out
    run = read_run(path)
    assert run.summary().wall_s == 0
    assert run.time_range() == (0.0, 0.07)
    for time in (math.inf, 1e300, 2.0**63):
        found = run.state_at(time)
        assert found is not None
        assert found.step == 7
    assert run.state_at(-math.inf) is None
    assert run.cameras() == []
    with pytest.raises(ValueError, match="the time is NaN"):
        run.state_at(math.nan)


@pytest.mark.parametrize(
    ("mode", "colour", "shown"),
    [
        ("RGB", (255, 0, 0), (255, 0, 0)),
        ("RGBA", (255, 0, 0, 255), (255, 0, 0)),
        ("L", 200, (200, 200, 200)),
        ("P", 0, (0, 0, 0)),
        ("LA", (200, 255), (200, 200, 200)),
    ],
)
def test_pictures_of_every_kind_have_their_colours(mode: str, colour: Any, shown: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "picture.mcap", [picture(png(8, 8, mode, colour))._replace(metadata={"mode": "semantic"})])
    assert complaints(path, tmp_path) == []
    (found,) = read_run(path).encoded_pictures("arm/eye")
    assert found.pixels()[0, 0, :3].tolist() == [*shown]
    np.testing.assert_allclose(np.array(Image.open(io.BytesIO(_jpeg_of(found))))[0, 0], shown, atol=3)


@pytest.mark.parametrize("far", [0.0, -1.0, 1e-45, 3e38, math.inf, math.nan])
def test_depths_without_a_range_become_a_video(far: float, tmp_path: Path) -> None:
    depth = encode(RawImage(ZERO, "", 4, 2, "32FC1", 16, np.array([far, 0, 0, -3e38] * 2, "<f4").tobytes()))
    assert complaints(write(tmp_path / "depth.mcap", [depths()._replace(data=depth)]), tmp_path) == []


def test_a_chunk_without_messages_has_no_time(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    path.write_bytes(chunk(b"", 0, b""))
    assert complaints(path, tmp_path) == []
    assert read_run(path).summary().wall_s == 0


@pytest.mark.parametrize(
    "text",
    [
        '{"Frames": [{"timestamp": 1e300}]}',
        '{"Frames": [{"timestamp": 9e9}, {"timestamp": -9e9}, {"timestamp": 9e9}]}',
        '{"Frames": [{"timestamp": 1' + "0" * 400 + "}]}",
        '{"Frames": [{"timestamp": NaN}]}',
        '{"Frames": [{"jointStates": {"' + "j" * 5000 + '": {}}}]}',
        '{"Frames": [' + "[" * 10**5,
        '{"Frames": [{}',
        '{"Frames": [{}]',
        '{"Frames": 3}',
        '{"Frames": [{"timestamp": "\xff"}]}',
    ],
    ids=lambda text: text[12:60],
)
def test_wrong_joint_states_are_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.json"
    path.write_bytes(text.encode("latin-1"))
    assert complaints(path, tmp_path)


@pytest.mark.parametrize(
    "text", ['{"Frames": []}', '{"Frames": [3, null, {"jointStates": {"j": 1, "k": {"qPos": "x"}}}]}']
)
def test_odd_joint_states_are_read(text: str, tmp_path: Path) -> None:
    path = tmp_path / "odd.json"
    path.write_text(text)
    assert complaints(path, tmp_path) == []


# Memory


def chunk(packed: bytes, size: int, compression: bytes = b"zstd") -> bytes:
    """A file without an index, of one chunk that declares a size."""
    body = (
        struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression + struct.pack("<Q", len(packed)) + packed
    )
    return b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(body)) + body


def unsized(data: bytes) -> bytes:
    """Compress data so that the result does not say how large they are."""
    made = zstandard.ZstdCompressor().compressobj()
    return made.compress(data) + made.flush()


def small_state(number: int, qpos: str = "0") -> Message:
    stamp = '{"sec":0,"nsec":0}'
    times = f'"timestamp":{stamp},"wall_time":{stamp},"sim_time":0'
    text = f'{{{times},"sample":{number},"step":0,"episode":0,"qpos":[{qpos}],"qvel":[]}}'
    return state()._replace(data=text.encode())


def spaces(path: Path, compression: CompressionType = CompressionType.ZSTD) -> None:
    """One message in one chunk, of which a few kilobytes are left."""
    write(path, [state()._replace(data=b" " * 80 * MIB + state().data)], compression=compression)


@pytest.mark.parametrize(
    "make",
    [
        spaces,
        lambda path: spaces(path, CompressionType.LZ4),
        lambda path: path.write_bytes(chunk(zstandard.compress(b"\0" * 80 * MIB), 1000)),
        lambda path: path.write_bytes(chunk(unsized(b"\0" * 80 * MIB), 1000)),
        lambda path: path.write_bytes(chunk(lz4.frame.compress(b"\0" * 80 * MIB), 1000, b"lz4")),
        lambda path: path.write_bytes(chunk(unsized(b""), 80 * MIB)),
        lambda path: write(path, [picture(png(9000, 9000, "L"))]),
    ],
    ids=["zstd", "LZ4", "zstd lies", "zstd does not say", "LZ4 lies", "empty", "picture"],
)
def test_a_small_file_does_not_unpack_to_a_large_one(make: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "small.mcap"
    make(path)
    assert path.stat().st_size < MIB
    assert peak_of(lambda: complaints(path, tmp_path)) < 50 * MIB


def peak_of(use: Callable[[], Any]) -> int:
    tracemalloc.start()
    try:
        use()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def overlapping(path: Path) -> None:
    """An index that lists one chunk of many messages again and again."""
    write(path, [small_state(number) for number in range(1500)], enable_crcs=False)
    data = bytearray(path.read_bytes())
    start, footer = struct.unpack("<Q", data[-28:-20])[0], len(data) - 37
    summary, at = bytes(data[start:footer]), 0
    while summary[at] != Opcode.CHUNK_INDEX:
        at += 9 + struct.unpack("<Q", summary[at + 1 : at + 9])[0]
    data[footer:footer] = summary[at : at + 9 + struct.unpack("<Q", summary[at + 1 : at + 9])[0]] * 1000
    path.write_bytes(data)


def episode(_: int) -> Message:
    varied = [{"what": "", "by": "", "drawn": {}}] * 200
    return other(EpisodeMessage, timestamp=STAMP, episode=0, seed=0, varied=varied)


def unindexed(path: Path) -> None:
    write(path, [small_state(number) for number in range(3000)], index_types=IndexType.NONE)


def test_a_file_without_chunks_says_what_would_be_right(tmp_path: Path) -> None:
    path = write(tmp_path / "run.mcap", [state(at) for at in range(20)], use_chunking=False)
    assert "write the file with chunks" in read_run(path).damage


def test_chunks_are_limited_in_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index, "_MOST_BLOCKS", 10)
    path = write(tmp_path / "run.mcap", [state(at) for at in range(20)], chunk_size=1)
    assert len(read_run(path).table()) == 20, "the index lists them"
    monkeypatch.setattr(index, "_SUMMARY_BYTES", 100)
    assert "more than 10 chunks" in read_run(path).damage
    path.write_bytes(path.read_bytes()[:-40])
    assert "more than 10 chunks" in read_run(path).damage


JOINTS = b'{"Frames": [' + b"{}," * 20_000 + b"{}]}"
WIDE = b'{"Frames": [{"jointStates": {"j": {"qPos": [' + b"0," * 999 + b"0]}}}" + b",{}" * 2000 + b"]}"
OVERSIZED: dict[str, tuple[Callable[[Path], Any], Callable[[Run], Any], str]] = {
    "schema": (
        lambda path: write(path, [state()._replace(schema="x" * MIB)]),
        lambda run: run.summary(),
        "declares|take more than",
    ),
    "layout": (
        lambda path: write(path, [state()._replace(metadata={"layout": " " * MIB + "{}"})]),
        lambda run: run.summary(),
        "declares|take more than",
    ),
    "message": (lambda path: write(path, [small_state(0, "[]," * MIB)]), lambda run: run.state_at(0), "it has 3"),
    "values": (
        lambda path: write(path, [small_state(at, "0," * 999 + "0") for at in range(900)]),
        lambda run: run.table(),
        "samples of 1005 values are too many",
    ),
    "missing values": (
        lambda path: write(path, [small_state(at, "0," * 900 * (not at) + "0") for at in range(900)]),
        lambda run: run.table(),
        "samples of 906 values are too many",
    ),
    "episodes": (
        lambda path: write(path, [episode(at) for at in range(300)]),
        lambda run: run.summary(),
        "larger than the file",
    ),
    "overlapping index": (overlapping, lambda run: run.summary(), "the end of the file is missing"),
    "no index": (unindexed, lambda run: run.summary(), "are in no index"),
    "names": (
        lambda path: write(path, [state(sensors={"x" * 999: [0.0] * 9000})]),
        lambda run: run.table(),
        "the names of its sensors are too long",
    ),
    "joints": (lambda path: path.write_bytes(JOINTS), lambda run: run.table(), "bytes of memory"),
    "what are no frames of joints": (
        lambda path: path.write_bytes(b'{"Frames": [' + b"0," * MIB + b"0]}"),
        lambda run: run.table(),
        "its frames take more than 8388608 bytes of memory",
    ),
    "a frame of joints": (
        lambda path: path.write_bytes(b'{"Frames": [["' + b"x" * MIB + b'"]]}'),
        lambda run: run.table(),
        "a frame has more than 16384 bytes",
    ),
    "beside joints": (
        lambda path: path.write_bytes(b'{"Frames": [], "more": [' + b"{}," * MIB + b"{}]}"),
        lambda run: run.table(),
        "its frames take more than 8388608 bytes of memory",
    ),
    "missing joints": (
        lambda path: path.write_bytes(WIDE),
        lambda run: run.table(),
        "samples of 1005 values are too many",
    ),
}


@pytest.mark.parametrize("kind", OVERSIZED)
def test_what_a_file_declares_has_limits(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, limit in (
        *((index, "_DECLARED_BYTES"), (index, "_MOST_WALKED"), (reader, "_MESSAGE_BYTES"), (reader, "_KEPT_BYTES")),
        *((reader, "_MOST_VALUES"), (reader, "_VALUES_PER_BYTE"), (reader, "_NAMES_CHARS")),
        *((recording, "_READ_BYTES"), (recording, "_FRAME_BYTES")),
    ):
        monkeypatch.setattr(module, limit, getattr(module, limit) // (5000 if limit == "_MOST_WALKED" else 128))
    make, use, said = OVERSIZED[kind]
    path = tmp_path / ("run.json" if "joints" in kind else "run.mcap")
    make(path)

    def tried() -> str:
        try:
            use(run := read_run(path))
        except RecordingError as error:
            return str(error)
        return f"{run.path}: {run.damage}"

    assert re.search(rf"{path.name}: .*({said})", tried())
    assert peak_of(tried) < max(7 * MIB, 3 * path.stat().st_size)
