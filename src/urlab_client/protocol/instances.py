"""The registry of running servers: location and format of its files. No I/O except reading the environment.

Each server keeps one JSON file in a folder shared by all servers of a machine. A file shows that the server existed
when it was last written; only a request shows whether it still does. Beside the files is the folder through which
programs hand models to servers of the same user.
"""

from __future__ import annotations

import datetime as dt
import os
import sys
from pathlib import Path
from typing import Annotated, Final

import msgspec

from urlab_client.protocol.base import doc
from urlab_client.protocol.messages.session import InstanceInfo

REWRITE_S: Final = 10.0
"""Seconds after which a server renews its file."""


class RegisteredInstance(InstanceInfo, kw_only=True):
    """Contents of a server's file. In the plugin's files, `manager_present` is never true."""

    registry_written_at: Annotated[
        str | float | None, doc("When it was written: ISO 8601 text in UTC, or Unix seconds.")
    ] = None

    @property
    def written_at(self) -> float | None:
        """When it was written, Unix seconds; None if missing or unreadable."""
        said = self.registry_written_at
        if not isinstance(said, str):
            return said
        try:
            moment = dt.datetime.fromisoformat(said)
        except ValueError:
            return None
        return (moment if moment.tzinfo else moment.replace(tzinfo=dt.UTC)).timestamp()


def registry_directory() -> Path:
    """Return the folder of the registry, which may not exist."""
    named = os.environ.get("URLAB_REGISTRY_DIR")
    if named:
        return Path(named)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "URLab" / "registry"


def import_directory() -> Path | None:
    """Return the folder from which every simulated server of this user imports models; it may not exist.

    None for a user without a home folder.
    """
    try:
        return registry_directory() / "imports"
    except RuntimeError:
        return None


def encode(instance: InstanceInfo, now: dt.datetime) -> bytes:
    """Return the contents of a server's file."""
    told = {name: getattr(instance, name) for name in instance.__struct_fields__}
    entry = RegisteredInstance(**told, registry_written_at=now.astimezone(dt.UTC).isoformat())
    return msgspec.json.encode(entry)


def decode(data: bytes) -> RegisteredInstance:
    """Read a server's file.

    Raises:
        ValueError: The file is not a server's file.
    """
    try:
        return msgspec.json.decode(data, type=RegisteredInstance, strict=False)
    except RecursionError as error:
        raise ValueError(str(error)) from None
