"""Files of the registry of servers: when one was written, where they lie, and what is none."""

from __future__ import annotations

import datetime as dt
import sys
from pathlib import Path

import msgspec
import pytest

from urlab_client.protocol import instances
from urlab_client.protocol.messages.session import InstanceInfo

NOON = dt.datetime(2026, 3, 1, 12, tzinfo=dt.UTC)


@pytest.mark.parametrize(
    ("said", "moment"),
    [
        ("2026-03-01T12:00:00+00:00", NOON.timestamp()),
        ("2026-03-01T12:00:00", NOON.timestamp()),
        ("2026-03-01T13:30:00+01:30", NOON.timestamp()),
        (NOON.timestamp(), NOON.timestamp()),
        (0, 0.0),
        (None, None),
        ("at noon", None),
    ],
)
def test_the_time_of_a_file_is_text_or_seconds(said: object, moment: float | None) -> None:
    found = instances.decode(msgspec.json.encode({"registry_written_at": said}))
    assert found.written_at == moment


def test_a_file_says_what_its_server_says_and_when() -> None:
    told = InstanceInfo(host="lab", step_port=5555)
    paris = NOON.astimezone(dt.timezone(dt.timedelta(hours=1)))
    found = instances.decode(instances.encode(told, paris))
    assert (found.host, found.step_port, found.written_at) == ("lab", 5555, NOON.timestamp())
    assert found.registry_written_at == "2026-03-01T12:00:00+00:00"


@pytest.mark.parametrize("data", [b"", b"[]", b'{"step_port": "many"}', b'{"x":' + b"[" * 100_000])
def test_other_files_are_refused(data: bytes) -> None:
    with pytest.raises(ValueError):  # noqa: PT011 - its text is msgspec's
        instances.decode(data)


@pytest.mark.parametrize(
    ("system", "variables", "folder"),
    [
        ("linux", {"URLAB_REGISTRY_DIR": "/here"}, "/here"),
        ("linux", {"XDG_CACHE_HOME": "/cache"}, "/cache/URLab/registry"),
        ("linux", {}, "/home/ann/.cache/URLab/registry"),
        ("darwin", {"XDG_CACHE_HOME": "/cache"}, "/home/ann/Library/Caches/URLab/registry"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/URLab/registry"),
        ("win32", {}, "/home/ann/AppData/Local/URLab/registry"),
    ],
)
def test_the_registry_lies_where_the_system_keeps_such_files(
    monkeypatch: pytest.MonkeyPatch, system: str, variables: dict[str, str], folder: str
) -> None:
    for name in ("URLAB_REGISTRY_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(Path, "home", lambda: Path("/home/ann"))
    assert instances.registry_directory() == Path(folder)
    assert instances.import_directory() == Path(folder) / "imports"


def test_a_user_without_a_home_has_no_folder_of_imports(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("URLAB_REGISTRY_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", none)
    assert instances.import_directory() is None
