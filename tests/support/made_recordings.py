"""Recordings written without a simulation: long ones, and such as a scene that changes leaves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from urlab_client.integrations._feed.messages import (
    ArticulationMessage,
    EntityMessage,
    Time,
    encode,
    schema_name,
    schema_of,
)

PERIOD_NS = 10_000_000


class Robot:
    """One articulation at one moment: joint positions, and readings of sensors."""

    def __init__(self, qpos: list[float], sensors: Mapping[str, list[float]] | None = None) -> None:
        self.qpos = qpos
        self.sensors = dict(sensors or {})


def write_recording(
    path: Path,
    samples: Iterable[tuple[Mapping[str, Robot], Mapping[str, list[float]]]],
    *,
    episode_length: int = 100,
    chunk_size: int = 1 << 20,
    period_ns: int = PERIOD_NS,
) -> None:
    """Write samples, each of articulations by key and of positions of entities by name, by default 100 a second."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, compression=CompressionType.ZSTD)
        writer.start(profile="", library="tests")
        schemas = {
            kind: writer.register_schema(schema_name(kind), "jsonschema", schema_of(kind))
            for kind in (ArticulationMessage, EntityMessage)
        }
        channels: dict[str, int] = {}

        def add(topic: str, message: ArticulationMessage | EntityMessage, sample: int) -> None:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schemas[type(message)])
            writer.add_message(channels[topic], sample * period_ns, encode(message), 0)

        for sample, (robots, entities) in enumerate(samples):
            stamp = Time.of(sample * period_ns)
            episode, step = divmod(sample, episode_length)
            for key, robot in robots.items():
                message = ArticulationMessage(
                    timestamp=stamp,
                    sim_time=step * period_ns / 1e9,
                    sample=sample,
                    step=step,
                    episode=episode,
                    wall_time=stamp,
                    qpos=robot.qpos,
                    qvel=robot.qpos,
                    set_points=[float(sample)],
                    ctrl=[float(sample)],
                    act=[],
                    sensors=robot.sensors,
                )
                add(f"/state/{key}", message, sample)
            for name, position in entities.items():
                pose = EntityMessage(
                    timestamp=stamp,
                    sim_time=step * period_ns / 1e9,
                    sample=sample,
                    step=step,
                    episode=episode,
                    position=position,
                    orientation=[1.0, 0.0, 0.0, 0.0],
                    qvel=[],
                )
                add(f"/entity/{name}", pose, sample)
        writer.finish()


def with_later_pictures(source: Path, target: Path, by_ns: int) -> None:
    """Copy a recording, with its pictures later than the states that they show."""
    with source.open("rb") as original, target.open("wb") as file:
        reader, writer = make_reader(original), Writer(file)
        header = reader.get_header()
        writer.start(profile=header.profile, library=header.library)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind, channel.metadata
                )
            later = by_ns if channel.topic.startswith("/camera/") else 0
            writer.add_message(channels[channel.id], message.log_time + later, message.data, message.publish_time)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()


class Message(NamedTuple):
    """A message, and the channel that it is on."""

    topic: str
    schema: str
    time: int
    data: bytes
    metadata: dict[str, str]
    publish_time: int = 0


def messages_of(path: Path) -> list[Message]:
    with path.open("rb") as file:
        return [
            Message(channel.topic, schema.name, one.log_time, one.data, channel.metadata, one.publish_time)
            for schema, channel, one in make_reader(file).iter_messages(log_time_order=False)
            if schema is not None
        ]


def write_messages(path: Path, content: Sequence[Message], **options: Any) -> Path:
    """Write messages into one chunk with right checksums."""
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 1 << 40, "compression": CompressionType.ZSTD, **options})
        writer.start(profile="", library="tests")
        schemas: dict[str, int] = {}
        channels: dict[Any, int] = {}
        for one in content:
            if one.schema not in schemas:
                schemas[one.schema] = writer.register_schema(one.schema, "jsonschema", b"{}")
            channel = one.topic, one.schema, *sorted(one.metadata.items())
            if channel not in channels:
                channels[channel] = writer.register_channel(one.topic, "json", schemas[one.schema], one.metadata)
            writer.add_message(channels[channel], one.time, one.data, one.publish_time)
        writer.add_metadata("urlab", {"format": "1"})
        writer.finish()
    return path
