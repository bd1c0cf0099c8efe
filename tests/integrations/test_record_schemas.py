"""Recorded messages are what Foxglove's own library says they are."""

from __future__ import annotations

import importlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.json_format import ParseDict
from google.protobuf.message_factory import GetMessages
from mcap.reader import make_reader

import urlab_client
from urlab_client.integrations.record import record
from urlab_client.server import SimulatedServer

FIELD = importlib.import_module("google.protobuf.descriptor_pb2").FieldDescriptorProto


UNUSED = {"lifetime", "metadata", "arrows", "lines", "texts", "models"}
"""Fields of a scene's entities that recordings leave at their defaults."""


def theirs(name: str) -> tuple[Any, dict[str, Any]]:
    """Return Foxglove's class of a message, and its definitions of all messages in it."""
    schema = getattr(importlib.import_module("foxglove.messages"), name.removeprefix("foxglove.")).get_schema()
    assert schema.name == name
    files = FileDescriptorSet.FromString(schema.data).file
    definitions = {f".{file.package}.{kind.name}": kind for file in files for kind in file.message_type}
    return GetMessages(files)[name], definitions


def json_type(field: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON schema that a field of theirs has in JSON, required fields and all."""
    numbers = {FIELD.TYPE_DOUBLE, FIELD.TYPE_FLOAT}
    if field.type == FIELD.TYPE_MESSAGE and field.type_name == ".google.protobuf.Timestamp":
        kind: dict[str, Any] = {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}
        kind = {"type": "object", "properties": kind}
    elif field.type == FIELD.TYPE_MESSAGE:
        inner = definitions[field.type_name].field
        kind = {"type": "object", "properties": {each.name: json_type(each, definitions) for each in inner}}
    elif field.type == FIELD.TYPE_BOOL:
        kind = {"type": "boolean"}
    elif field.type == FIELD.TYPE_BYTES:
        kind = {"type": "string", "contentEncoding": "base64"}
    else:
        kind = {
            "type": "number" if field.type in numbers else "string" if field.type == FIELD.TYPE_STRING else "integer"
        }
    return {"type": "array", "items": kind} if field.label == FIELD.LABEL_REPEATED else kind


def assert_fits(ours: dict[str, Any], wanted: dict[str, Any], optional: set[str]) -> None:
    """Assert that a schema has the types of the other one, and lacks at most what is optional there."""
    assert ours["type"] == wanted["type"]
    assert ours.get("contentEncoding") == wanted.get("contentEncoding")
    if "items" in wanted:
        assert_fits(ours["items"], wanted["items"], optional)
    if "properties" in wanted:
        missing = wanted["properties"].keys() - ours["properties"].keys()
        assert missing <= optional
        assert ours["properties"].keys() <= wanted["properties"].keys()
        for name, each in ours["properties"].items():
            assert_fits(each, wanted["properties"][name], optional)


def with_their_times(node: Any) -> Any:
    """Return a message with times as protobuf writes them in JSON; Foxglove has them in two parts."""
    if isinstance(node, list):
        return [with_their_times(each) for each in node]
    if isinstance(node, dict) and node.keys() == {"sec", "nsec"}:
        return f"{datetime.fromtimestamp(node['sec'], UTC):%Y-%m-%dT%H:%M:%S}.{node['nsec']:09}Z"
    return {key: with_their_times(each) for key, each in node.items()} if isinstance(node, dict) else node


@pytest.mark.opengl
def test_foxglove_knows_every_schema_and_reads_every_message(tmp_path: Path) -> None:
    with (
        SimulatedServer("quadruped", "arm", play=True, camera_modes={"arm/wrist": "depth"}) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        with record(client, tmp_path / "run.mcap", cameras="all"):
            for _ in range(5):
                client.step(n_steps=10)
    read: dict[str, int] = {}
    with (tmp_path / "run.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if schema.name.startswith("foxglove."):
                kind, definitions = theirs(schema.name)
                fields = definitions[f".{schema.name}"].field
                assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
                wanted = {"type": "object", "properties": {each.name: json_type(each, definitions) for each in fields}}
                optional = {f.name for d in definitions.values() for f in d.field if f.proto3_optional}
                optional |= UNUSED if schema.name == "foxglove.SceneUpdate" else set()
                assert_fits(json.loads(schema.data), wanted, optional)
                parsed = ParseDict(with_their_times(json.loads(message.data)), kind())  # refuses what it does not know
                assert parsed.ByteSize() > 0
                read[schema.name] = read.get(schema.name, 0) + 1
    kinds = ("CameraCalibration", "CompressedImage", "FrameTransforms", "JointStates", "RawImage", "SceneUpdate")
    assert read.keys() == {f"foxglove.{name}" for name in kinds}
    assert read["foxglove.FrameTransforms"] == 5
    assert read["foxglove.SceneUpdate"] == 1
