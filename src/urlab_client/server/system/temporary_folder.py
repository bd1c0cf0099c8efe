"""Temporary folders that are removed even if their process is killed.

A folder contains a lock that ends with the process. Creating a folder removes those beside it whose lock is free.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Final, Self

_LOCK: Final = ".alive"


class TemporaryFolder:
    """A temporary folder of this process.

    Not a `tempfile.TemporaryDirectory`, which a forked child would remove.
    """

    path: Path

    def __init__(self, root: Path | None = None, prefix: str = "urlab-") -> None:
        """Create the folder, and remove those of killed processes.

        Args:
            root: Where to create it; None for the system's folder of temporary files.
            prefix: Beginning of its name, and of the names of those that are removed.
        """
        root = Path(tempfile.gettempdir()) if root is None else root
        sweep(root, prefix)
        self._pid = os.getpid()
        self._lock: int | None = None
        while self._lock is None:
            self.path = Path(tempfile.mkdtemp(prefix=prefix, dir=root))
            self._lock = _hold(self.path / _LOCK, os.O_RDWR | os.O_CREAT)
            # Between creating and locking the file, another process may have removed it as a leftover.
            if self._lock is not None and not (self.path / _LOCK).exists():
                os.close(self._lock)
                self._lock = None

    def close(self) -> None:
        """Remove the folder. Idempotent; a forked child leaves it to its parent."""
        if self._lock is None or os.getpid() != self._pid:
            return
        os.close(self._lock)
        self._lock = None
        shutil.rmtree(self.path, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, exc_type: type[BaseException] | None, exc: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def sweep(root: Path, prefix: str) -> None:
    """Remove the temporary folders of killed processes."""
    for folder in root.glob(f"{prefix}*"):
        with contextlib.suppress(OSError):
            _remove_if_left(folder)


def _hold(file: Path, flags: int) -> int | None:
    """Open and lock a file; None if another process holds it. Without support for locks, it is only opened."""
    descriptor = os.open(file, flags, 0o600)
    if sys.platform != "win32":
        import fcntl

        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            return None
        except OSError:  # nobody can tell then whether its owner lives: only a new file may be held
            if not flags & os.O_CREAT:
                os.close(descriptor)
                return None
    return descriptor


def _remove_if_left(folder: Path) -> None:
    if folder.is_symlink():
        return
    if sys.platform == "win32":
        (folder / _LOCK).unlink()  # fails while its owner has it open
        shutil.rmtree(folder, ignore_errors=True)
        return
    if folder.stat().st_uid != os.geteuid():
        return
    descriptor = _hold(folder / _LOCK, os.O_RDWR)
    if descriptor is not None:
        try:
            shutil.rmtree(folder, ignore_errors=True)
        finally:
            os.close(descriptor)
