"""Registration of a server for clients on the same machine, by a file that is renewed regularly."""

from __future__ import annotations

import contextlib
import datetime as dt
import logging
import threading
from collections.abc import Callable
from pathlib import Path

from urlab_client._platform.files import write_whole
from urlab_client.protocol import instances
from urlab_client.protocol.messages.session import InstanceInfo
from urlab_client.server.system.threads import Health, ended

logger: logging.Logger = logging.getLogger("urlab_client.server")


class Registration:
    """Keeps the file of one server in the registry for as long as the server is open."""

    def __init__(self, directory: Path, describe: Callable[[], InstanceInfo], health: Health) -> None:
        self._directory = directory
        self._describe = describe
        self._path: Path | None = None
        self._stopping = threading.Event()
        self._thread = health.thread("urlab-registry", self._run)

    def start(self) -> None:
        """Write the file, and renew it before it would be considered stale."""
        self._write()
        self._thread.start()

    def stop(self) -> None:
        """Ask the thread to end."""
        self._stopping.set()

    def join(self, timeout: float) -> bool:
        """Wait for the thread to end and remove the file; return False if the thread is still busy."""
        if self._thread.ident is not None:
            ended(self._thread, timeout)
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink()
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._stopping.wait(instances.REWRITE_S):
            self._write()

    def _write(self) -> None:
        instance = self._describe()
        path = self._directory / f"{instance.instance_id}_{instance.pid}.json"
        try:
            write_whole(path, instances.encode(instance, dt.datetime.now(dt.UTC)), durable=False)
        except OSError as error:
            logger.warning("the server is not in the registry: %s", error)
        else:
            self._path = path
