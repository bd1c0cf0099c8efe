"""Temporary folders that are removed even if their process is killed.

A folder contains a lock that ends with the process. Creating a folder removes those whose lock is free. `working_in`
and `sweep` do the same for folders that several processes use.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from urlab_client._platform.windows import NamedLock

_PREFIX: Final = "urlab-"
_LOCK: Final = ".alive"
_LOOK_S: Final = 0.01


class TemporaryFolder:
    """A temporary folder of this process.

    Not a `tempfile.TemporaryDirectory`, which a forked child would remove.
    """

    path: Path

    def __init__(self, root: Path | None = None) -> None:
        """Create the folder, and remove those of killed processes.

        Args:
            root: Where to create it; None for the system's folder of temporary files.
        """
        root = Path(tempfile.gettempdir()) if root is None else root
        for folder in root.glob(f"{_PREFIX}*"):
            with contextlib.suppress(OSError):
                _remove_if_left(folder)
        self._pid = os.getpid()
        self._lock: int | None = None
        while self._lock is None:
            self.path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=root))
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


@contextlib.contextmanager
def working_in(folder: Path) -> Generator[None]:
    """Keep `sweep` in other processes from removing unfinished files below a folder.

    Raises:
        OSError: The folder cannot be opened.
    """
    if sys.platform == "win32":
        works = NamedLock(_name("works", folder))  # before checking for a sweep, which checks in the same order
        try:
            while not _is_free("sweeps", folder):
                time.sleep(_LOOK_S)
            yield
        finally:
            works.close()
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_SH)
        yield
    finally:
        os.close(descriptor)


def sweep(folder: Path, *patterns: str) -> None:
    """Remove leftovers of killed processes below a folder, unless another process is using it."""
    with contextlib.suppress(OSError), _alone_in(folder):
        for pattern in patterns:
            for left in folder.glob(pattern):
                shutil.rmtree(left, ignore_errors=True)
                with contextlib.suppress(OSError):
                    left.parent.rmdir()  # if it held nothing else


@contextlib.contextmanager
def _alone_in(folder: Path) -> Generator[None]:
    """Lock a folder; raises `OSError` while a process is using it, or if it does not exist."""
    if sys.platform == "win32":
        sweeps = NamedLock(_name("sweeps", folder))
        try:
            if not sweeps.held or not _is_free("works", folder):
                raise BlockingIOError(f"another process is using {folder}")
            yield
        finally:
            sweeps.close()
        return
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _name(what: str, folder: Path) -> str:
    """Return the name of a lock file for Windows, where folders cannot be locked."""
    place = os.path.normcase(folder.resolve())
    return f"Local\\urlab_{what}_{hashlib.sha256(place.encode()).hexdigest()}"


def _is_free(what: str, folder: Path) -> bool:
    lock = NamedLock(_name(what, folder))
    lock.close()
    return lock.held
