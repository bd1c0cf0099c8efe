"""Whatever a test of the console does: refusals are of use to people and programs, and messages are as declared."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest

from urlab_client.console import messages, shared_view
from urlab_client.protocol.codec import from_wire_array


@pytest.fixture(autouse=True)
def _refusals_explain_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    testing: Any = sys.modules.get("starlette.testclient")  # not there where the extra is not installed
    if testing is None:
        return
    send = testing.TestClient.send

    def checked(self: Any, *args: Any, **kwargs: Any) -> Any:
        answer = send(self, *args, **kwargs)
        if answer.status_code >= 400 and answer.headers.get("content-type", "").startswith("application/json"):
            error = answer.json().get("error", {})
            assert isinstance(error.get("code"), str), answer.text
            assert error["code"].isidentifier(), answer.text
            assert isinstance(error.get("message"), str), answer.text
            assert error["message"], answer.text
            assert isinstance(error.get("hint"), str), answer.text
            assert error["hint"] == "" or " " in error["hint"], answer.text
        return answer

    monkeypatch.setattr(testing.TestClient, "send", checked)


@pytest.fixture(autouse=True)
def _messages_are_as_declared(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    wrong: list[str] = []
    encoder = messages._encoder

    def checked_entry(*values: object) -> messages.LogEntry:  # which not every test waits to be sent
        return msgspec.convert(dict(zip(messages.LogEntry.__struct_fields__, values, strict=True)), messages.LogEntry)

    class Checked:
        def encode(self, value: object) -> bytes:
            encoded = encoder.encode(value)
            if isinstance(value, msgspec.Struct):
                try:
                    msgspec.json.decode(encoded, type=type(value), dec_hook=from_wire_array)
                except msgspec.ValidationError as error:
                    wrong.append(f"{type(value).__name__}: {error}")
            return encoded

    monkeypatch.setattr(messages, "_encoder", Checked())
    monkeypatch.setattr(shared_view, "LogEntry", checked_entry)
    yield
    assert not wrong
