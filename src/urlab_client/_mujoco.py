"""MuJoCo's layout of arrays, and all differences between the releases that this package supports: 3.8 and later.

Each difference is detected by checking which attributes MuJoCo has; nothing compares version numbers. If an older
release lacks a feature, this module works around it if possible; otherwise an error reports it.

Importing this module must not import MuJoCo, which takes longer than the rest of the client.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import importlib
import re
import tempfile
import zipfile
from collections.abc import Callable, Generator, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import mujoco

T = TypeVar("T")
Indices = NDArray[np.int32]

MODEL_FILE = "model.xml"


QPOS_WIDTH = np.array([7, 4, 1, 1])  # by mjtJoint: free, ball, slide, hinge
QVEL_WIDTH = np.array([6, 3, 1, 1])


def spans(starts: NDArray[np.integer[Any]], lengths: NDArray[np.integer[Any]]) -> NDArray[np.intp]:
    """Concatenate the ranges [start, start + length)."""
    lengths = lengths.astype(np.intp)
    first = np.repeat(starts.astype(np.intp) - (np.cumsum(lengths) - lengths), lengths)
    return first + np.arange(lengths.sum(), dtype=np.intp)


def contiguous(places: NDArray[np.intp]) -> slice | NDArray[np.intp]:
    """Return places as a slice if they follow each other: that is written three times as fast."""
    ordered: list[int] = places.tolist()
    if ordered and ordered == list(range(ordered[0], ordered[0] + len(ordered))):
        return slice(ordered[0], ordered[0] + len(ordered))
    return places


_NO_COLOUR = (0.5, 0.5, 0.5, 1.0)  # of geoms, as MuJoCo compiles them
_NAME_ADDRESSES = {
    "body": "name_bodyadr",
    "joint": "name_jntadr",
    "actuator": "name_actuatoradr",
    "sensor": "name_sensoradr",
    "geom": "name_geomadr",
    "site": "name_siteadr",
    "camera": "name_camadr",
    "light": "name_lightadr",
    "material": "name_matadr",
    "key": "name_keyadr",
}


def model_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Return the compiled names of all elements of a kind, in id order; those without a name are empty."""
    pool = model.names
    addresses: list[int] = getattr(model, _NAME_ADDRESSES[kind]).tolist()
    return [pool[start : pool.index(b"\0", start)].decode() for start in addresses]


def shown_colours(model: mujoco.MjModel, rgba: NDArray[Any], geoms: NDArray[np.intp]) -> NDArray[Any]:
    """Return a copy of the colours that are drawn: those of the material, unless a geom has one of its own."""
    shown, material = rgba[geoms], model.geom_matid[geoms]
    covered = np.flatnonzero((material >= 0) & (shown == _NO_COLOUR).all(axis=1))
    shown[covered] = model.mat_rgba[material[covered]]
    return shown


# Since 3.11 an actuator may have several controls and forces; before, `nu` counted both actuators and controls.


def actuator_count(model: mujoco.MjModel) -> int:
    """Return the number of actuators."""
    return int(getattr(model, "nactuator", model.nu))


def control_starts(model: mujoco.MjModel) -> Indices:
    """Return the index of each actuator's first control in `ctrl`, shape (actuators,)."""
    return _per_actuator(model, "actuator_ctrladr")


def control_counts(model: mujoco.MjModel) -> Indices:
    """Return the number of controls of each actuator, shape (actuators,)."""
    return _per_actuator(model, "actuator_ctrlnum")


def force_starts(model: mujoco.MjModel) -> Indices:
    """Return the index of each actuator's first force in `actuator_force`, shape (actuators,)."""
    return _per_actuator(model, "actuator_outadr")


def force_counts(model: mujoco.MjModel) -> Indices:
    """Return the number of forces of each actuator, shape (actuators,)."""
    return _per_actuator(model, "actuator_outnum")


def _per_actuator(model: mujoco.MjModel, field: str) -> Indices:
    one_each = np.arange(model.nu, dtype=np.int32)
    return getattr(model, field, one_each if field.endswith("adr") else np.ones_like(one_each))


def reset_controls(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set controls to neutral values: zero, except for quaternion inputs, which exist since 3.11."""
    import mujoco

    if hasattr(mujoco, "mj_resetCtrl"):
        mujoco.mj_resetCtrl(model, data)
    else:
        data.ctrl[:] = 0.0


def actuator_kind(actuator: Any) -> str:
    """Return the MJCF element that an actuator of an `MjSpec` was written as: `motor`, `position`, `general`, ….

    Up to 3.15 MuJoCo does not keep it: a `general` then counts as the shortcut with the same kinds of gain and bias.
    """
    if hasattr(actuator, "type"):
        return _constant(actuator.type).lower()
    return _kind_by_parameters(actuator.dyntype, actuator.gaintype, actuator.biastype, actuator.trntype, actuator)


def acting_kind(model: mujoco.MjModel, actuator: int) -> str:
    """Return the MJCF element that has the gain and bias of a compiled actuator.

    A `general` with those of a servo counts as a servo, because `MjSpec.to_xml()` writes servos that way.
    """
    import mujoco

    element = model.actuator(actuator)
    return _kind_by_parameters(
        mujoco.mjtDyn(int(model.actuator_dyntype[actuator])),
        mujoco.mjtGain(int(model.actuator_gaintype[actuator])),
        mujoco.mjtBias(int(model.actuator_biastype[actuator])),
        mujoco.mjtTrn(int(model.actuator_trntype[actuator])),
        element,
    )


def servo_damping(model: mujoco.MjModel, actuator: int) -> float:
    """Return the velocity gain of an actuator: from an affine bias, otherwise from its gain."""
    import mujoco

    if model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_AFFINE:
        return -float(model.actuator_biasprm[actuator][2]) + 0.0  # no negative zero
    return float(model.actuator_gainprm[actuator][1])


def _kind_by_parameters(dyntype: Any, gaintype: Any, biastype: Any, trntype: Any, parameters: Any) -> str:
    dynamics, gain, bias = (_constant(value) for value in (dyntype, gaintype, biastype))
    if dynamics in ("MUSCLE", "DCMOTOR"):
        return dynamics.lower()
    if bias == "AFFINE":
        stiffness = parameters.biasprm[1]
        if dynamics == "FILTER" and not (stiffness and stiffness == -parameters.gainprm[0]):
            return "cylinder"
        servo = "position" if stiffness else "velocity"
        return {"INTEGRATOR": "intvelocity"}.get(dynamics, servo)
    if gain == "AFFINE":
        return "damper"
    return "adhesion" if _constant(trntype) == "BODY" else "motor"


def _constant(value: Any) -> str:
    """Return the last part of an enumeration member: `FIXED` for `mjGAIN_FIXED`."""
    return str(value.name).partition("_")[2]


def thread_limit(processors: int) -> int:
    """Return the number of threads that one simulation can use: 0 before 3.10, whose bindings have no thread pool."""
    import mujoco

    return processors if hasattr(mujoco, "mju_threadpool") else 0


def set_threads(data: mujoco.MjData, threads: int) -> None:
    """Let one simulation use `threads` threads, at most `thread_limit`."""
    import mujoco

    if hasattr(mujoco, "mju_threadpool"):
        mujoco.mju_threadpool(data, threads)


def compiled_file(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file.

    Raises:
        ValueError, mujoco.FatalError: MuJoCo rejects the model.
    """
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(path))
    forget_last_document()
    return model


def forget_last_document() -> None:
    """Free the data that `MjModel.from_xml_path` and similar functions keep of the last model for `mj_saveLastXML`.

    It is larger than the model.
    """
    import mujoco

    mujoco.MjModel.from_xml_string("<mujoco/>")


def write_model(spec: mujoco.MjSpec, folder: Path) -> None:
    """Write a spec and every file that it needs to a folder, as `model.xml` and files beside it.

    The numbers are those of the source; before 3.16 they are those of the compiled model, rounded to six digits.

    Raises:
        mujoco.FatalError: The spec must be compiled first; before 3.16 always.
        ValueError: One of its files is not where this MuJoCo searches for it; see `check_copy`.
        OSError: The disk is full.
    """
    text, files = flat_model(spec, scratch=folder.parent)
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    (folder / MODEL_FILE).write_text(text, "utf-8")


def flat_model(
    spec: mujoco.MjSpec, *, compiled: bool = False, scratch: Path | None = None
) -> tuple[str, dict[str, bytes]]:
    """Return a spec as MJCF whose files all have bare names, and their contents by those names.

    Args:
        compiled: Whether the numbers are those of the compiled model; before 3.16 they always are.
        scratch: Folder in which files may be written meanwhile; None for the system's temporary one.

    Raises:
        mujoco.FatalError: The spec must be compiled first, as always if it has attached parts.
        ValueError: One of its files is not where this MuJoCo searches for it; see `check_copy`.
    """
    copied = spec.copy()
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        if _writes_archives(copied):
            compiler: Any = copied.compiler
            compiler.savecompiled = compiled
            assets: list[Any] = [*copied.meshes, *copied.hfields, *copied.textures, *copied.skins]
            if copied.strippath or any(asset.compiler is not compiler for asset in assets):
                copied = _gathered(copied, Path(folder))
        else:
            copied.to_xml()  # raises if it cannot be written, before its files are read
        files = _give_bare_names(copied)
        return _for_older_releases(spec, _text(copied, files, Path(folder))), files


def _writes_archives(spec: mujoco.MjSpec) -> bool:
    """Return whether MuJoCo can write a spec with its files. Before 3.16 it misnames files in separate folders."""
    return hasattr(spec.compiler, "savecompiled")


def _gathered(spec: mujoco.MjSpec, folder: Path) -> mujoco.MjSpec:
    """Return a spec with all its files in a folder, also those of attached parts, whose places only MuJoCo knows."""
    import mujoco

    with _archive(spec, folder) as content:
        content.extractall(folder)
    gathered = mujoco.MjSpec.from_file(str(folder / MODEL_FILE))
    compiler: Any = gathered.compiler
    compiler.savecompiled = False  # the numbers are what they should be
    return gathered


@contextlib.contextmanager
def _archive(spec: mujoco.MjSpec, folder: Path) -> Generator[zipfile.ZipFile]:
    path = folder / "model.mjz"  # its stem is the name of the model inside
    spec.encode(str(path))
    try:
        content = zipfile.ZipFile(path)
    except zipfile.BadZipFile:  # MuJoCo does not notice an incomplete write
        raise OSError(errno.ENOSPC, "MuJoCo could not write the whole file; is the disk full?", str(path)) from None
    with content:
        yield content


def _give_bare_names(spec: mujoco.MjSpec) -> dict[str, bytes]:
    """Give the files of a spec names of their own without folders, and return their contents by these."""
    files: dict[str, bytes] = {}
    compilers: list[Any] = [spec.compiler]  # and those of attached parts

    def renamed(file: str, directory: str) -> str:
        data = spec.assets.get(file)
        if data is None:
            try:
                data = Path(spec.modelfiledir, directory, file).read_bytes()
            except OSError:
                raise _unwritable() from None
        digest = hashlib.sha256(data).hexdigest()[:16]
        name = re.sub(r"[^\w.-]", "_", Path(file).name, flags=re.ASCII)  # others MuJoCo changes in an archive
        name = name if name.startswith(digest) else f"{digest}-{name}"
        files[name] = data
        return name

    for asset in (*spec.meshes, *spec.hfields, *spec.skins):
        if asset.file:
            asset.file = renamed(asset.file, asset.compiler.meshdir)
            compilers.append(asset.compiler)
    for texture in spec.textures:
        directory = texture.compiler.texturedir
        if texture.file:
            texture.file = renamed(texture.file, directory)
        texture.cubefiles = [renamed(file, directory) if file else "" for file in texture.cubefiles]
        compilers.append(texture.compiler)
    for compiler in compilers:
        compiler.meshdir = compiler.texturedir = ""
    return files


def _text(spec: mujoco.MjSpec, files: Mapping[str, bytes], folder: Path) -> str:
    """Return a spec as MJCF, after `_give_bare_names`."""
    if _writes_archives(spec):
        spec.assets = dict.fromkeys(files, b"-")  # because packing the files would take as long as compiling them
        with _archive(spec, folder) as content:
            return content.read(MODEL_FILE).decode()
    # The compiler records the content type of files that its cache does not have. Assigning the given type undoes
    # that: a model is then always written in the same way, so that a server recognises it by its digest.
    spec.assets = {**spec.assets, **files}
    spec.compile()
    for asset in (*spec.meshes, *spec.hfields, *spec.textures):
        asset.content_type = str(asset.content_type)
    return spec.to_xml()


def _for_older_releases(spec: mujoco.MjSpec, text: str) -> str:
    """Return the MJCF of a spec without the attribute that MuJoCo adds to servos, and that older releases refuse.

    From 3.16 on MuJoCo writes a `position` as a `general` with `input="pos"`, and `velocity`, `intvelocity` and
    `cylinder` likewise. There it only tells what the control means. In a `pid` and its like it decides what the
    controls are, but a model that has one needs a newer release anyway.
    """
    if any(
        getattr(actuator, "ctrlspec", 0) and _constant(actuator.gaintype) not in _ONE_CONTROL
        for actuator in spec.actuators
    ):
        return text
    return _INPUT.sub(r"\1", text)


_ONE_CONTROL = {"FIXED", "AFFINE"}
_INPUT = re.compile(r'(<general\b[^<>]*?) input="[^"]*"')


def check_copy(original: Path, copy: mujoco.MjModel) -> None:
    """Refuse a wrong result of `write_model`: before 3.16, an attached model with files in a separate folder.

    Args:
        original: Source file of the model.
        copy: Compiled model of the written file.

    Raises:
        ValueError: Meshes, textures or height fields differ from those of the original.
    """
    import mujoco

    if _writes_archives(mujoco.MjSpec()):
        return
    model = compiled_file(original)
    for name in ("mesh_vert", "tex_data", "hfield_data", "skin_vert"):
        ours, theirs = getattr(copy, name), getattr(model, name)
        if ours.shape != theirs.shape or not np.allclose(ours, theirs, atol=1e-4):
            raise _unwritable()


def _unwritable() -> ValueError:
    return ValueError(
        f"MuJoCo {mujoco_version()} cannot write a model whose attached parts have files in separate folders. "
        "Put the files beside the model, or use MuJoCo 3.16 or later."
    )


def without_newer_attributes(
    xml: str, assets: Mapping[str, bytes], compiled: Callable[[str, Mapping[str, bytes]], T]
) -> tuple[T, list[str]]:
    """Compile an MJCF written by a newer MuJoCo; return the result and the attributes that had to be omitted.

    An attribute is omitted if this MuJoCo does not know it or its keyword value.

    Args:
        xml: The model.
        assets: Its files by name, including attached documents (`.xml`).
        compiled: Compiles a model with its files.

    Raises:
        ValueError: The model cannot be compiled for another reason.
    """
    left_out: list[str] = []
    untried: list[tuple[str, list[str]]] = []
    complaint: tuple[str, ...] = ()
    names = [name for name in assets if name.lower().endswith(".xml")]
    texts = [xml, *(assets[name].decode("utf-8", "surrogateescape") for name in names)]
    while True:
        try:
            attached = {
                name: text.encode("utf-8", "surrogateescape") for name, text in zip(names, texts[1:], strict=True)
            }
            return compiled(texts[0], {**assets, **attached}), left_out
        except ValueError as error:
            found = _UNKNOWN.search(str(error))
            if found is None:
                raise
            if untried and found.groups() == complaint:
                left_out.pop()  # the complaint is about another attribute with the same value
            else:
                untried = _without_one_attribute(texts, *found.groups())
                complaint = found.groups()
            if not untried:
                raise
            name, texts = untried.pop()
            left_out.append(name)


_UNKNOWN = re.compile(r"(unrecognized attribute|invalid keyword): '([^'\"]+)'\s+Element '([\w:-]+)'")


def _without_one_attribute(texts: list[str], problem: str, word: str, element: str) -> list[tuple[str, list[str]]]:
    """Return each attribute that MuJoCo may complain about, with the texts without it."""
    attributes = [word]
    if problem == "invalid keyword":
        tags = " ".join(tag for text in texts for tag in re.findall(rf"<{element}\b[^<>]*", text))
        attributes = sorted(set(re.findall(rf'\s([\w:-]+)="{re.escape(word)}"', tags)))
    value = re.escape(word) if problem == "invalid keyword" else '[^"]*'
    shorter: list[tuple[str, list[str]]] = []
    for attribute in attributes:
        there = re.compile(rf'(<{element}\b[^<>]*?)\s{re.escape(attribute)}="{value}"')
        shorter.append((f"{element}.{attribute}", [there.sub(r"\1", text) for text in texts]))
    return [(name, changed) for name, changed in shorter if changed != texts]


def mujoco_version() -> str:
    """Return the version of the installed MuJoCo."""
    import mujoco

    return mujoco.mj_versionString()


def saved_model(model: mujoco.MjModel) -> bytes:
    """Return a model in MuJoCo's binary format."""
    import mujoco

    buffer = np.zeros(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def option_names(options: Any) -> list[str]:
    """Return the names of the options of a model or spec."""
    return [name for name in dir(options) if not name.startswith("_") and not callable(getattr(options, name))]


def copy_options(source: Any, target: Any) -> None:
    """Copy all options of a model or spec to another; before 3.10 they must be copied one by one."""
    for name in option_names(source):
        setattr(target, name, getattr(source, name))


@cache
def option_choices() -> Mapping[str, Mapping[str, int]]:
    """Return the numbers of the integrators, cones and solvers by lower-case name: `euler`, `elliptic`, `newton`."""
    import mujoco

    kinds = ("integrator", mujoco.mjtIntegrator), ("cone", mujoco.mjtCone), ("solver", mujoco.mjtSolver)
    return {
        option: {name.partition("_")[2].lower(): int(member) for name, member in kind.__members__.items()}
        for option, kind in kinds
    }


def write_options(option: mujoco.MjOption, values: Mapping[str, Any]) -> None:
    """Write options by name; `enable_multiccd` and `enable_sleep` take precedence over the masks that they are part of.

    Args:
        option: Options of a model.
        values: As in `mjOption`, besides these two; integrator, cone and solver are numbers.
    """
    import mujoco

    for name, value in values.items():
        if not name.startswith("enable_"):
            setattr(option, name, value)
    if "enable_sleep" in values:
        bit = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        option.enableflags = option.enableflags & ~bit | bit * values["enable_sleep"]
    if "enable_multiccd" in values:
        bit = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
        option.disableflags = option.disableflags & ~bit | bit * (not values["enable_multiccd"])


def batch_class() -> Any:
    """Return `mujoco.batch.Batch`; None before 3.17."""
    try:
        return importlib.import_module("mujoco.batch").Batch
    except ImportError:
        return None


def asset_bytes(model: mujoco.MjModel) -> int:
    """Return the size of a model's meshes and textures, which `merge_assets` shares, in bytes.

    Before 3.17 nothing is shared, and this is 0.
    """
    import mujoco

    if not hasattr(mujoco.MjSpec, "dedup_assets"):
        return 0
    return sum(getattr(model, name).nbytes for name in dir(model) if name.startswith(("mesh_", "tex_")))


def merge_assets(spec: mujoco.MjSpec, folders: Iterable[Path]) -> None:
    """Let instances of one robot share its meshes and textures; before 3.17 each has its own, which takes more memory.

    Args:
        spec: Spec that the robots are attached to.
        folders: Folders that `write_model` wrote for them.
    """
    if hasattr(spec, "dedup_assets"):
        spec.dedup_assets()
    if not _writes_archives(spec):
        files = [file for folder in folders for file in folder.iterdir() if file.name != MODEL_FILE]
        spec.assets = {file.name: file.read_bytes() for file in files}
