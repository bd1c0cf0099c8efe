"""The registry of running servers: where their files are, and what they say. No I/O beyond looking at the environment.

Each server keeps one file of JSON in a folder that all of a machine share. A file says that there was a server when it
was written last; whether there still is one shows only by asking it.
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

__all__ = ["REWRITE_S", "STALE_S", "RegisteredInstance", "decode", "encode", "registry_directory"]

REWRITE_S: Final = 10.0
"""Seconds after which a server writes its file again."""

STALE_S: Final = 30.0
"""Seconds after which a server whose file was not written is taken for dead."""


class RegisteredInstance(InstanceInfo, kw_only=True):
    """What the file of a server says. `manager_present` is never true in the plugin's."""

    registry_written_at: Annotated[
        str | float | None, doc("When it was written: ISO 8601 text in UTC, or Unix seconds.")
    ] = None

    @property
    def written_at(self) -> float | None:
        """When it was written, Unix seconds; None where it does not say so in a way that is understood."""
        said = self.registry_written_at
        if not isinstance(said, str):
            return said
        try:
            moment = dt.datetime.fromisoformat(said)
        except ValueError:
            return None
        return (moment if moment.tzinfo else moment.replace(tzinfo=dt.UTC)).timestamp()


def registry_directory() -> Path:
    """Return the folder of the registry, which need not exist."""
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


def encode(instance: InstanceInfo, now: dt.datetime) -> bytes:
    """Return what a server's file says."""
    told = {name: getattr(instance, name) for name in instance.__struct_fields__}
    entry = RegisteredInstance(**told, registry_written_at=now.astimezone(dt.UTC).isoformat())
    return msgspec.json.encode(entry)


def decode(data: bytes) -> RegisteredInstance:
    """Read a server's file.

    Raises:
        ValueError: It is none.
    """
    return msgspec.json.decode(data, type=RegisteredInstance, strict=False)
