"""Compiling the models of strangers in a child process with limits: those of untrusted servers, and uploads.

For the mirror and the console. MuJoCo's compiler uses as much memory and time as a model requires, cannot be cancelled,
reads the files that the model names, and may crash because it is written in C++. The child process contains these
failures.
"""

from __future__ import annotations

import importlib
import itertools
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PureWindowsPath
from typing import Final

import msgspec

from urlab_client._platform.children import APART
from urlab_client._sandbox.confined import forbid_opening, limit_process
from urlab_client._sandbox.landlock import confine_files
from urlab_client._sandbox.mjcf_files import NamedFiles, named_files
from urlab_client.aio.model.archive import unpacked
from urlab_client.aio.model.upload import FlatModel, flatten

log: logging.Logger = logging.getLogger("urlab_client.mirror")

_MEMORY_BYTES: Final = 2 * 2**30
_CPU_S: Final = 30
_WALL_S: Final = 60
_UPLOAD_MEMORY_BYTES: Final = 2**30
_UPLOAD_CPU_S: Final = 10
_UPLOAD_WALL_S: Final = 30
_MAX_COMBINATIONS: Final = 100_000
_LOOK_S: Final = 0.1
_ROOM: Final = Path("upload")
"""In the child's folder, the upload's content lies in here, so that one `..` too many leads to an empty folder."""

_NEEDED: Final = ("mujoco", "urlab_client._mujoco", "encodings.cp437")
"""Modules for `flatten` and `unpacked`, which a confined process can no longer import."""

_ITS_OWN: Final = "a model may name only files that come with it, by relative paths"
_DONE: Final = b"+"
_REFUSED: Final = b"-"


class _CompileJob(msgspec.Struct, tag="compile"):
    """The job that the child reads from its standard input."""

    xml: str
    assets: Mapping[str, bytes]
    memory_bytes: int
    cpu_s: int


class _FlattenJob(msgspec.Struct, tag="flatten"):
    """Likewise, for a file in the child's folder."""

    file: str
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
    with tempfile.TemporaryDirectory(prefix="urlab-", ignore_cleanup_errors=True) as folder:
        return _in_child(_CompileJob(xml, assets, _MEMORY_BYTES, _CPU_S), folder, _WALL_S)


def flatten_confined(file: Path, progress: Callable[[int], object] = lambda _: None) -> FlatModel:
    """Do what `flatten` does, for a file that may name only files that came with it. Blocks for a bounded time.

    Args:
        file: The model, or a ZIP archive with it and its files, which ends with `.zip`. The folder of the file is the
            child's: it must hold nothing else, and its content is undefined afterwards.
        progress: Callback invoked about ten times a second. If it raises, the work is broken off.

    Raises:
        ValueError: The model or the archive is invalid or exceeds a limit; the message says which.
    """
    job = _FlattenJob(file.name, _UPLOAD_MEMORY_BYTES, _UPLOAD_CPU_S)
    return msgspec.msgpack.decode(_in_child(job, str(file.parent), _UPLOAD_WALL_S, progress), type=FlatModel)


def _in_child(
    job: _CompileJob | _FlattenJob, folder: str, wall_s: float, progress: Callable[[int], object] = lambda _: None
) -> bytes:
    """Have a job done by a child process that may write only to a folder.

    Raises:
        ValueError: The child refused, failed, or exceeded a limit.
    """
    deadline = time.monotonic() + wall_s
    command = [sys.executable, "-m", __name__, folder]
    pipe = subprocess.PIPE
    try:
        process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, **APART)  # noqa: S603
    except OSError as error:
        raise ValueError(f"the compiling process could not be started: {error}") from error
    with process:
        try:
            output, errors = _communicate(process, msgspec.msgpack.encode(job), deadline, progress)
        except TimeoutError:
            raise ValueError(f"compiling it took more than {wall_s:g} s") from None
        finally:
            process.kill()
    if process.returncode == 0 and output.startswith(_DONE):
        return output[1:]
    if process.returncode == 0 and output.startswith(_REFUSED):
        raise ValueError(output[1:].decode(errors="replace"))
    log.debug("the compiling process exited with code %d: %s", process.returncode, errors.decode(errors="replace"))
    if sys.platform != "win32" and process.returncode == -signal.SIGXCPU:
        raise ValueError(f"compiling it took more than {job.cpu_s} s of processor time")
    raise ValueError(f"MuJoCo failed on it, or compiling it needs more than {job.memory_bytes >> 20} MiB")


def _communicate(
    process: subprocess.Popen[bytes], sent: bytes | None, deadline: float, progress: Callable[[int], object]
) -> tuple[bytes, bytes]:
    while True:
        try:
            return process.communicate(sent, timeout=_LOOK_S)
        except subprocess.TimeoutExpired:
            if time.monotonic() > deadline:
                raise TimeoutError from None
            sent = None  # it is on its way
            progress(0)


# The child.


def _main(folder: str) -> None:
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keeps what libraries print out of the result
    job = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=_CompileJob | _FlattenJob)
    try:
        result = _DONE + (_compile(job, folder) if isinstance(job, _CompileJob) else _flatten(job, folder))
    except Exception as error:  # noqa: BLE001 - the client reports every error
        said = " ".join(str(error).split())
        if isinstance(error, MemoryError) or "allocate memory" in said or "unknown exception" in said:
            said = f"compiling it needs more than {job.memory_bytes >> 20} MiB; MuJoCo says: {said or 'nothing'}"
        result = _REFUSED + said.encode(errors="replace")
    output.write(result)
    output.flush()


def _compile(job: _CompileJob, folder: str) -> bytes:
    import mujoco
    import numpy as np

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


def _flatten(job: _FlattenJob, folder: str) -> bytes:
    for module in _NEEDED:
        importlib.import_module(module)
    os.chdir(folder)  # so that messages do not say where it is
    limit_process(job.memory_bytes, job.cpu_s)
    confine_files(readable=(), writable=(Path(folder),))
    file, content = Path(job.file), _ROOM / "content"
    _ROOM.mkdir()
    if file.suffix.lower() == ".zip":
        file = unpacked(file, content)
    else:
        content.mkdir()
        file = file.rename(content / file.name)
    try:
        _refuse_outside(file, content)
        return msgspec.msgpack.encode(flatten(file))
    except ValueError as error:
        said = str(error).removeprefix("upload_model: ").replace(f"{content.as_posix()}/", "")
        raise ValueError(said) from None


def _refuse_local_files(xml: str, assets: Mapping[str, bytes]) -> None:
    """Reject a model that names files of this machine, because MuJoCo would read them."""
    named = _named_by_all(xml.encode(), assets, assets.__getitem__)
    names = named.documents | named.data
    names |= {_last_part(name) for name in names}
    if len(names) * (len(named.folders) + 1) > _MAX_COMBINATIONS:
        raise ValueError("it names too many files")
    for path in {os.path.join(folder, name) for folder in ("", *named.folders) for name in names}:
        if os.path.lexists(path) and not os.path.isdir(path):
            raise ValueError(f"it names {path}, a file of this machine")


def _refuse_outside(file: Path, content: Path) -> None:
    """Reject a model that names files outside its folder, whether they exist or not: that is not for it to know."""
    files = {path.as_posix(): path for path in content.rglob("*") if path.is_file()}
    named = _named_by_all(file.read_bytes(), files, lambda name: files[name].read_bytes())
    names, folders = named.documents | named.data, {"", *named.folders}
    for path in names | folders:
        if PureWindowsPath(path).anchor:  # a system's root, or a drive
            raise ValueError(f"{file.name} names {path}: {_ITS_OWN}")
    bases = {Path(name).parent.as_posix() for name in (file.as_posix(), *_alike(files, named.documents))}
    if len(names) * len(folders) * len(bases) > _MAX_COMBINATIONS:
        raise ValueError(f"{file.name} names too many files")
    for base, folder, name in itertools.product(bases, folders, names):
        if Path(os.path.normpath(f"{base}/{folder}/{name}")).parts[:1] != _ROOM.parts:
            raise ValueError(f"{file.name} names {name}, outside its folder: {_ITS_OWN}")


def _named_by_all(document: bytes, files: Iterable[str], read: Callable[[str], bytes]) -> NamedFiles:
    """Return the files named by a model and by those of its files that MuJoCo may read as documents."""
    named = named_files(document)
    unread = set(files)
    while found := _alike(unread, named.documents):
        unread -= found
        for name in found:
            try:
                named |= named_files(read(name))
            except ValueError as error:
                raise ValueError(f"it names {name}; {error}") from None
    return named


def _alike(files: Iterable[str], names: Iterable[str]) -> set[str]:
    """Return the files that one of the names may mean on some system."""
    parts = {_last_part(name).casefold() for name in names}
    return {file for file in files if _last_part(file).casefold() in parts}


def _last_part(name: str) -> str:
    return name.rpartition("/")[2]


if __name__ == "__main__":
    _main(sys.argv[1])
