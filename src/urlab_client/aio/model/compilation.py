"""Compiling the model of an untrusted server in a child process with limits.

For the mirror. MuJoCo's compiler uses as much memory and time as a model requires, cannot be cancelled, reads the files
that the model names, and may crash because it is written in C++. The child process contains these failures.
"""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import msgspec

from urlab_client._children import APART
from urlab_client._confined import forbid_opening, limit_process
from urlab_client._landlock import confine_files
from urlab_client._mjcf_files import NamedFiles, named_files

__all__ = ["compile_confined"]

log: logging.Logger = logging.getLogger("urlab_client.mirror")

_MEMORY_BYTES: Final = 2 * 2**30
_CPU_S: Final = 30
_WALL_S: Final = 60
_MAX_COMBINATIONS: Final = 100_000
_DONE: Final = b"+"
_REFUSED: Final = b"-"


class _CompileJob(msgspec.Struct):
    """The job that the child reads from its standard input."""

    xml: str
    assets: Mapping[str, bytes]
    memory_bytes: int
    cpu_s: int


def compile_confined(xml: str, assets: Mapping[str, bytes]) -> bytes:
    """Compile an MJCF to a binary model. Blocks for a bounded time.

    Args:
        xml: The model.
        assets: Its files, by name. The model must not name other existing files.

    Raises:
        ValueError: The model is invalid or exceeds a limit; the message says which.
    """
    job = msgspec.msgpack.encode(_CompileJob(xml, assets, _MEMORY_BYTES, _CPU_S))
    try:
        with tempfile.TemporaryDirectory(prefix="urlab-", ignore_cleanup_errors=True) as folder:
            command = [sys.executable, "-m", __name__, folder]
            done = subprocess.run(  # noqa: S603
                command, input=job, capture_output=True, timeout=_WALL_S, check=False, **APART
            )
    except subprocess.TimeoutExpired:
        raise ValueError(f"compiling it took more than {_WALL_S} s") from None
    except OSError as error:
        raise ValueError(f"the compiling process could not be started: {error}") from error
    if done.returncode == 0 and done.stdout.startswith(_DONE):
        return done.stdout[1:]
    if done.returncode == 0 and done.stdout.startswith(_REFUSED):
        raise ValueError(done.stdout[1:].decode(errors="replace"))
    log.debug("the compiling process exited with code %d: %s", done.returncode, done.stderr.decode(errors="replace"))
    if sys.platform != "win32" and done.returncode == -signal.SIGXCPU:
        raise ValueError(f"compiling it took more than {_CPU_S} s of processor time")
    raise ValueError(f"MuJoCo failed on it, or compiling it needs more than {_MEMORY_BYTES >> 20} MiB")


# The child.


def _main(folder: str) -> None:
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keeps what libraries print out of the result
    job = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=_CompileJob)
    try:
        result = _DONE + _compile(job, folder)
    except MemoryError:
        result = _REFUSED + b"compiling it needs more than %d MiB" % (job.memory_bytes >> 20)
    except Exception as error:  # noqa: BLE001 - the client reports every error
        result = _REFUSED + " ".join(str(error).split()).encode()
    output.write(result)
    output.flush()


def _compile(job: _CompileJob, folder: str) -> bytes:
    import mujoco  # noqa: PLC0415
    import numpy as np  # noqa: PLC0415

    os.chdir(folder)  # empty, and deleted together with MuJoCo's log
    limit_process(job.memory_bytes, job.cpu_s)
    _refuse_local_files(job.xml, job.assets)
    # All input came through standard input, so MuJoCo does not need to open any file.
    confine_files(readable=(), writable=(Path(folder),))
    forbid_opening()
    compiled = mujoco.MjModel.from_xml_string(job.xml, dict(job.assets))
    mujoco.mj_forward(compiled, mujoco.MjData(compiled))  # the client calls it first, and it may never return
    buffer = np.zeros(mujoco.mj_sizeModel(compiled), dtype=np.uint8)
    mujoco.mj_saveModel(compiled, None, buffer)
    return buffer.tobytes()


def _refuse_local_files(xml: str, assets: Mapping[str, bytes]) -> None:
    """Reject a model that names files of this machine, because MuJoCo would read them."""
    named = _named_by_all(xml, assets)
    names = named.documents | named.data
    names |= {_last_part(name) for name in names}
    if len(names) * (len(named.folders) + 1) > _MAX_COMBINATIONS:
        raise ValueError("it names too many files")
    for path in {os.path.join(folder, name) for folder in ("", *named.folders) for name in names}:
        if os.path.lexists(path) and not os.path.isdir(path):
            raise ValueError(f"it names {path}, a file of this machine")


def _named_by_all(xml: str, assets: Mapping[str, bytes]) -> NamedFiles:
    """Return the files named by the model and by those of its files that MuJoCo may read as documents."""
    named = named_files(xml.encode())
    unread = dict(assets)
    while found := [name for name in unread if _last_part(name) in set(map(_last_part, named.documents))]:
        for name in found:
            try:
                named |= named_files(unread.pop(name))
            except ValueError as error:
                raise ValueError(f"it names {name}; {error}") from None
    return named


def _last_part(name: str) -> str:
    return name.rpartition("/")[2]


if __name__ == "__main__":
    _main(sys.argv[1])
