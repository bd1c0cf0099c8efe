"""Compiling the models of strangers in a confined process: those of untrusted servers, and uploads.

For the mirror and the console.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import msgspec

from urlab_client._mujoco import saved_model
from urlab_client._sandbox.confinement import forbid_opening
from urlab_client._sandbox.process import Job, ProcessLimits, run_confined
from urlab_client._sandbox.references import refuse_local_files, refuse_outside
from urlab_client.aio.model.archive import unpacked
from urlab_client.aio.model.upload import FlatModel, flatten

LIMITS: Final = ProcessLimits(memory_bytes=2 * 2**30, cpu_s=30, wall_s=60)
"""For the model of an untrusted server."""

UPLOAD_LIMITS: Final = ProcessLimits(memory_bytes=2**30, cpu_s=10, wall_s=30)

_CONTENT: Final = Path("upload", "content")
"""In the process's folder, the upload's content lies in here, so that one `..` too many leads to an empty folder."""

_NEEDED: Final = ["mujoco", "numpy", "urlab_client._mujoco", "encodings.cp437"]
"""Modules that the work imports, or `flatten` and `unpacked`; a confined process cannot."""


class _Model(msgspec.Struct):
    xml: str
    assets: Mapping[str, bytes]


def compile_confined(xml: str, assets: Mapping[str, bytes]) -> bytes:
    """Compile an MJCF to a binary model. Blocks for a bounded time.

    Args:
        xml: The model.
        assets: Its files, by name. The model must not name other existing files.

    Raises:
        ValueError: The model is invalid or exceeds a limit; the message says which.
    """
    with tempfile.TemporaryDirectory(prefix="urlab-", ignore_cleanup_errors=True) as folder:
        argument = msgspec.msgpack.encode(_Model(xml, assets))
        work = f"{__name__}:compile_model"
        return run_confined(Job(work=work, argument=argument, limits=LIMITS, folder=folder, modules=_NEEDED))


def flatten_confined(file: Path, progress: Callable[[int], object] = lambda _: None) -> FlatModel:
    """Do what `flatten` does, for a file that may name only files that came with it. Blocks for a bounded time.

    Args:
        file: The model, or a ZIP archive with it and its files, which ends with `.zip`. The folder of the file is the
            process's: it must hold nothing else, and its content is undefined afterwards.
        progress: Callback invoked about ten times a second. If it raises, the work is broken off.

    Raises:
        ValueError: The model or the archive is invalid or exceeds a limit; the message says which.
    """
    work, folder = f"{__name__}:flatten_upload", str(file.parent)
    job = Job(work=work, argument=file.name.encode(), limits=UPLOAD_LIMITS, folder=folder, modules=_NEEDED)
    return msgspec.msgpack.decode(run_confined(job, progress), type=FlatModel)


def compile_model(argument: bytes) -> bytes:
    """Do the work of `compile_confined` in the confined process."""
    import mujoco

    job = msgspec.msgpack.decode(argument, type=_Model)
    refuse_local_files(job.xml, job.assets)
    forbid_opening()  # all input is here, so MuJoCo does not need to open any file
    compiled = mujoco.MjModel.from_xml_string(job.xml, dict(job.assets))
    mujoco.mj_forward(compiled, mujoco.MjData(compiled))  # the client calls it first, and it may never return
    return saved_model(compiled)


def flatten_upload(argument: bytes) -> bytes:
    """Do the work of `flatten_confined` in the confined process."""
    file = Path(argument.decode())
    _CONTENT.parent.mkdir()
    if file.suffix.lower() == ".zip":
        file = unpacked(file, _CONTENT)
    else:
        _CONTENT.mkdir()
        file = file.rename(_CONTENT / file.name)
    try:
        refuse_outside(file, _CONTENT)
        return msgspec.msgpack.encode(flatten(file, scratch=Path.cwd()))
    except ValueError as error:
        said = str(error).removeprefix("upload_model: ").replace(f"{_CONTENT.as_posix()}/", "")
        raise ValueError(said) from None
