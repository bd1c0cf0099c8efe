"""Recordings of the server: the plugin's JSON files of joint states, converted to recordings of our own."""

from __future__ import annotations

import io
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from mcap.writer import Writer

from urlab_client.integrations._feed.messages import ArticulationMessage, Time, encode, schema_name, schema_of
from urlab_client.integrations._feed.samples import SampleClock
from urlab_client.integrations._feed.scene import SceneLayout, to_metadata
from urlab_client.integrations.record.writer import RecordingError
from urlab_client.simulation.joint_recording import decode_json

_TOPIC = "/state/joints"
"""Topic of the only articulation, because the file names compiled joints and no robots."""

_NS = 1e9
_HEAD = 64
_LARGEST_FILE = 256 << 20
_LATEST_NS = 2**63 - 1
_COORDINATES = {1: ("",), 4: (".qw", ".qx", ".qy", ".qz"), 7: (".x", ".y", ".z", ".qw", ".qx", ".qy", ".qz")}
_VELOCITIES = {1: ("",), 3: (".wx", ".wy", ".wz"), 6: (".vx", ".vy", ".vz", ".wx", ".wy", ".wz")}


def is_joint_states(path: Path) -> bool:
    """Return whether a file begins like the plugin's recordings: an object with the list `Frames`."""
    with path.open("rb") as file:
        text = file.read(_HEAD).replace(b"\0", b"").lstrip(b"\xff\xfe\xef\xbb\xbf \t\r\n")
    return text[:1] == b"{" and text[1:].lstrip()[:8].lower() == b'"frames"'


def as_mcap(path: Path) -> bytes:
    """Return a file of joint states as an MCAP file, without set-points, sensors and pictures.

    Frames with other joints than the first one become states without values.
    """
    status = path.stat()
    if status.st_size > _LARGEST_FILE:
        raise RecordingError(f"{path}: {status.st_size} bytes are too many for a recording of joint states.")
    try:
        frames = decode_json(path.read_bytes())
        times = [round(frame.time * _NS) for frame in frames]
    except (ValueError, OverflowError) as error:
        raise RecordingError(f"{path}: {str(error).rstrip('.')}.") from error
    made = io.BytesIO()
    writer = Writer(made)
    writer.start(profile="", library="urlab-client")
    changed = datetime.fromtimestamp(status.st_mtime, UTC).isoformat(timespec="seconds")
    writer.add_metadata("urlab", {"started": changed, "address": "recorded by the server"})
    kind = ArticulationMessage
    schema = writer.register_schema(schema_name(kind), "jsonschema", schema_of(kind))
    layout = frames[0].layout if frames else None
    names = SceneLayout()
    if layout is not None:
        names.qpos = [name + part for name, (at, _) in layout.joints.items() for part in _parts(_COORDINATES, at)]
        names.qvel = [name + part for name, (_, at) in layout.joints.items() for part in _parts(_VELOCITIES, at)]
    channel = writer.register_channel(_TOPIC, "json", schema, to_metadata(names))
    clock = SampleClock(offset=-times[0] if times else 0)
    for number, (frame, sim) in enumerate(zip(frames, times, strict=True)):
        now = clock.advance(sim, restarts=False)
        if max(now, abs(sim)) > _LATEST_NS:
            raise RecordingError(f"{path}: its times reach {_LATEST_NS / _NS:.0f} s and more.")
        known = frame.layout is layout
        message = kind(
            timestamp=Time.of(now),
            sim_time=frame.time,
            sample=number,
            step=number,
            episode=clock.episode,
            wall_time=Time.of(now),
            qpos=frame.qpos.tolist() if known else [],
            qvel=frame.qvel.tolist() if known else [],
        )
        writer.add_message(channel, now, encode(message), now, number)
    writer.finish()
    return made.getvalue()


def _parts(kinds: Mapping[int, tuple[str, ...]], where: slice) -> tuple[str, ...]:
    width = where.stop - where.start
    return kinds.get(width, tuple(f".{i}" for i in range(width)))
