"""Importing an MJCF: a self-contained copy in which all elements have names, made here or in a confined process.

For `ContentRoot`, which determines the folders. Names and keyframes are those of the plugin's importer.
"""

from __future__ import annotations

import contextlib
import logging
import re
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import mujoco

from urlab_client._mujoco import (
    MODEL_FILE,
    actuator_count,
    actuator_kind,
    asset_bytes,
    check_copy,
    compiled_file,
    write_model,
)
from urlab_client._sandbox.process import Failed, Job, ProcessLimits, Refused, is_out_of_memory, run_confined
from urlab_client._sandbox.references import Outside, check_references
from urlab_client.server.limits import Limits, options_problem
from urlab_client.server.refusal import Refusal

logger: logging.Logger = logging.getLogger("urlab_client.server")

DEFAULT_MODEL_NAMES: Final = frozenset({"", "MuJoCo Model"})
"""MuJoCo's name for a model whose file gives none."""


def one_line(error: object) -> str:
    """Return MuJoCo's message, which may span lines, on one line."""
    return " ".join(str(error).split())


class ModelFacts(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of a compiled model.

    Attributes:
        model_name: The MJCF's `model` attribute; empty if it gives none.
        joints: Joint names in compiled order, without prefix. Every element has a name: see `named_kinds`.
        actuators: Actuator names in compiled order.
        actuator_types: Actuator name to MJCF element; `motor` for `<general>`.
        sensors: Sensor names in compiled order.
        cameras: Camera names in compiled order.
        n_bytes: Size of the compiled model; this and what follows is 0 where an older import did not note it.
        n_asset_bytes: The part of that for meshes and textures, which all robots of a kind share.
        n_data_bytes: Memory of its simulation, without the arena if MuJoCo chooses its size.
        n_sensor_values: Total size of its sensor readings, in numbers.
    """

    model_name: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    actuator_types: Mapping[str, str]
    sensors: tuple[str, ...]
    cameras: tuple[str, ...]
    n_bytes: int = 0
    n_asset_bytes: int = 0
    n_data_bytes: int = 0
    n_sensor_values: int = 0


class Compiled(ModelFacts, frozen=True, kw_only=True):
    """Properties of a compiled model.

    Attributes:
        messages: MuJoCo's warnings.
        n_arena_bytes: Memory of its arena.
        options_problem: What is wrong with its `<option>`, if anything.
        largest_image: Largest width or height of its cameras, pixels.
    """

    messages: tuple[str, ...]
    n_arena_bytes: int
    options_problem: str
    largest_image: int

    def facts(self) -> dict[str, Any]:
        """Return the fields of `ModelFacts`."""
        return {name: getattr(self, name) for name in ModelFacts.__struct_fields__}


class _Order(msgspec.Struct):
    """What a confined process is to import; the snapshot is a folder that does not exist yet."""

    file: str
    snapshot: str
    roots: list[str]
    limits: Limits


def build_confined(file: Path, snapshot: Path, roots: tuple[Path, ...], limits: Limits) -> Compiled:
    """Write and compile a snapshot in a confined process, for a file that may refer only to files below `roots`."""
    folders = [str(root) for root in roots]
    job = Job(
        work=f"{__name__}:build_order",
        argument=msgspec.msgpack.encode(_Order(str(file), str(snapshot), folders, limits)),
        limits=ProcessLimits(
            memory_bytes=limits.model_memory_bytes,
            cpu_s=limits.model_cpu_s,
            wall_s=limits.model_wall_s,
            prefix="model_",
        ),
        folder=str(snapshot.parent),
        readable=folders,
    )
    try:
        return msgspec.msgpack.decode(run_confined(job, keep=True), type=Compiled)
    except Refused as refused:
        raise Refusal("import_failed", str(refused)) from None
    except Failed as failed:
        raise Refusal("import_failed", f"{file}: {failed}") from None


def build_order(argument: bytes) -> bytes:
    """Do the work of `build_confined` in the confined process."""
    order = msgspec.msgpack.decode(argument, type=_Order)
    file, snapshot, limits = Path(order.file), Path(order.snapshot), order.limits
    most = limits.model_file_bytes, limits.model_files
    stage = f"cannot read {file}"
    try:
        check_references(file, tuple(map(Path, order.roots)), *most)
        stage = f"cannot store the snapshot of {file}"
        compiled, model = compile_snapshot(*write_snapshot(file, snapshot), file, snapshot, limits)
        check_references(snapshot / MODEL_FILE, (snapshot,), *most)  # the server reads it without restrictions
        exceeded = _exceeded(compiled, limits)
        if not exceeded:
            _simulate(model)
    except Outside as outside:
        raise ValueError(f"{file}: {outside}") from None
    except OSError as error:
        raise ValueError(f"{stage}: {error}") from None
    except Exception as error:
        if is_out_of_memory(error):
            raise
        raise ValueError(f"MuJoCo rejects {file}: {error}") from None
    if exceeded:
        raise ValueError(f"{file}: {exceeded}")
    return msgspec.msgpack.encode(compiled)


def _simulate(model: mujoco.MjModel) -> None:
    """Step once, so that a crash or an endless step happens here and not in the server."""
    with mujoco_messages(), contextlib.suppress(mujoco.FatalError):  # play has other options, and its own errors
        mujoco.mj_step(model, mujoco.MjData(model))


def _exceeded(compiled: Compiled, limits: Limits) -> str:
    """Return which limit a compiled model exceeds, or nothing."""
    n_data_bytes = max(compiled.n_data_bytes, compiled.n_arena_bytes)
    for what, value, name, limit in (
        ("compiled it takes {} bytes", compiled.n_bytes, "model_bytes", limits.model_bytes),
        ("simulating it takes {} bytes", n_data_bytes, "data_bytes", limits.data_bytes),
        ("its sensors give {} numbers", compiled.n_sensor_values, "sensor_values", limits.sensor_values),
        ("it has a camera of {} pixels", compiled.largest_image, "camera_side", limits.camera_side),
    ):
        if value > limit:
            return f"{what.format(value)}, more than the limit {name}, {limit}"
    return compiled.options_problem


def write_snapshot(file: Path, snapshot: Path) -> tuple[mujoco.MjSpec, list[str]]:
    """Write the snapshot of an MJCF file; return the spec that it was written from, and MuJoCo's warnings.

    Args:
        snapshot: Folder to write, which must not exist.

    Raises:
        ValueError, mujoco.FatalError: MuJoCo rejects it.
    """
    with mujoco_messages() as messages, _naming_the_source(file):
        spec = mujoco.MjSpec.from_file(str(file))
        if spec.compiler.settotalmass > 0.0 or any(len(key.mpos) or len(key.mquat) for key in spec.keys):
            compiled_file(file)  # for MuJoCo's warnings about what the snapshot omits
        prepared = _prepared(spec)
        _write_snapshot(prepared, snapshot, messages)
    return prepared, messages


def compile_snapshot(
    prepared: mujoco.MjSpec, warnings: list[str], file: Path, snapshot: Path, limits: Limits
) -> tuple[Compiled, mujoco.MjModel]:
    """Compile the snapshot of an MJCF file, and return its properties and the model.

    MuJoCo keeps compiled meshes by the paths of their files, so a snapshot compiled where it stays is compiled quickly
    from then on.

    Args:
        prepared: The first result of `write_snapshot`; the other one is `warnings`.
        limits: For the ranges of its options; nothing is refused here.

    Raises:
        ValueError, mujoco.FatalError: MuJoCo rejects it.
    """
    with mujoco_messages() as messages, _naming_the_source(file):
        model = compiled_file(snapshot / MODEL_FILE)
        data = mujoco.MjData(model)
        check_copy(file, model)
    compiled = Compiled(
        model_name="" if prepared.modelname in DEFAULT_MODEL_NAMES else prepared.modelname,
        joints=_names(model.njnt, model.joint),
        actuators=_names(actuator_count(model), model.actuator),
        actuator_types={actuator.name: _actuator_kind(actuator) for actuator in prepared.actuators},
        sensors=_names(model.nsensor, model.sensor),
        cameras=_names(model.ncam, model.camera),
        messages=tuple(dict.fromkeys((*warnings, *messages))),
        n_bytes=mujoco.mj_sizeModel(model),
        n_asset_bytes=asset_bytes(model),
        n_data_bytes=data.nbuffer + max(prepared.memory, 0),
        n_arena_bytes=data.narena,
        n_sensor_values=model.nsensordata,
        options_problem=options_problem(model.opt, limits),
        largest_image=int(model.cam_resolution.max(initial=0)),
    )
    return compiled, model


@contextlib.contextmanager
def _naming_the_source(file: Path) -> Generator[None]:
    """Let an error name the line of the file itself, if compiling that fails, too."""
    try:
        yield
    except (ValueError, mujoco.FatalError):
        compiled_file(file)
        raise


_hook_lock = threading.RLock()  # blocks may be nested: the inner one collects


@contextlib.contextmanager
def mujoco_messages() -> Generator[list[str]]:
    """Collect the warnings that MuJoCo gives this thread, instead of letting it print and write `MUJOCO_LOG.TXT`.

    MuJoCo has one handler per process. Warnings that other threads cause meanwhile go to the handler that was there,
    or else to the log.
    """
    thread = threading.get_ident()
    messages: list[str] = []
    with _hook_lock:
        previous: Callable[[str], None] | None = mujoco.get_mju_user_warning()

        def collect(text: str) -> None:
            if threading.get_ident() == thread:
                messages.append(text)
            elif previous is not None:
                previous(text)
            else:
                logger.warning("MuJoCo: %s", text)

        mujoco.set_mju_user_warning(collect)
        try:
            yield messages
        finally:
            mujoco.set_mju_user_warning(previous)


def _write_snapshot(spec: mujoco.MjSpec, folder: Path, messages: list[str]) -> None:
    """Write a spec to `folder` as `model.xml`, with all files that it needs."""
    before = len(messages)
    try:
        write_model(spec, folder)
    except mujoco.FatalError:
        # A model made of attached parts is written only once compilation has assembled its keyframes.
        del messages[before:]
        spec.compile()
        write_model(spec, folder)


def _names(count: int, element: Callable[[int], Any]) -> tuple[str, ...]:
    return tuple(element(index).name for index in range(count))


def _prepared(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy of a parsed spec with names and complete keyframes, as the plugin's importer does."""
    prepared = spec.copy()  # a copy no longer repeats the warnings of parsing when it is compiled
    prepared.compiler.settotalmass = -1.0  # has no effect once attached, and warns at every compilation
    _name_elements(prepared)
    _complete_keyframes(prepared)
    return prepared


_SENSOR_TAGS: Final = {
    "JOINTACTFRC": "Jointactuatorfrc",
    "TENDONACTFRC": "Tendonactuatorfrc",
    "GEOMDIST": "Distance",
    "GEOMNORMAL": "Normal",
    "GEOMFROMTO": "Fromto",
}
"""Sensors whose MJCF element is called differently from MuJoCo's constant."""


def _constant(value: Any) -> str:
    """Return the last part of an enumeration member: `SPHERE` for `mjGEOM_SPHERE`."""
    return str(value.name).partition("_")[2]


def _actuator_kind(actuator: Any) -> str:
    kind = actuator_kind(actuator)
    return "motor" if kind == "general" else kind


def _file_stem(asset: Any) -> str:
    return re.split(r"[/\\]", asset.file)[-1].rpartition(".")[0]


def named_kinds(spec: mujoco.MjSpec) -> list[tuple[Sequence[Any], Callable[[Any], str]]]:
    """Return the kinds of element that MJCF allows without a name, with the names that the plugin's importer gives."""
    return [
        (spec.bodies[1:], lambda body: f"{body.parent.name if body.parent.id else 'worldbody'}_Body"),
        (spec.joints, lambda joint: f"{_constant(joint.type).capitalize()}Joint"),
        (spec.geoms, lambda geom: f"Geom_{_constant(geom.type).capitalize()}"),
        (spec.sites, lambda _: "Site"),
        (spec.cameras, lambda _: "Camera"),
        (spec.lights, lambda _: "Light"),
        (spec.actuators, lambda actuator: f"{actuator_kind(actuator).capitalize()}Actuator"),
        (
            spec.sensors,
            lambda sensor: f"{_SENSOR_TAGS.get(_constant(sensor.type), _constant(sensor.type).capitalize())}Sensor",
        ),
        (spec.tendons, lambda _: "Tendon"),
        (spec.equalities, lambda equality: f"{_constant(equality.type).capitalize()}Equality"),
        (spec.pairs, lambda _: "Pair"),
        (spec.excludes, lambda _: "Exclude"),
        (spec.keys, lambda _: "Keyframe"),
        (spec.meshes, lambda mesh: _file_stem(mesh) or "Mesh"),
        (spec.hfields, lambda hfield: _file_stem(hfield) or "Hfield"),
        (spec.textures, lambda texture: _file_stem(texture) or "Texture"),
        (spec.skins, lambda _: "Skin"),
    ]


def _name_elements(spec: mujoco.MjSpec) -> None:
    """Give every unnamed element a name that is unique for its kind: `HingeJoint`, then `HingeJoint1`, …"""
    for elements, base in named_kinds(spec):
        taken = {element.name for element in elements}
        following: dict[str, int] = {}
        for element in elements:
            if element.name:
                continue
            stem = base(element)
            count = following.get(stem, 0)
            name = stem if count == 0 else f"{stem}{count}"
            while name in taken:
                count += 1
                name = f"{stem}{count}"
            following[stem] = count + 1
            taken.add(name)
            element.name = name


def _complete_keyframes(spec: mujoco.MjSpec) -> None:
    """Bring keyframes to the form in which the plugin merges them.

    Vectors that leave out the free joints get an identity block for each. Mocap poses are dropped: every key of a
    merged scene holds the compiled poses.
    """
    free = mujoco.mjtJoint.mjJNT_FREE
    widths = {free: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
    joints = [(joint.type == free, *widths.get(joint.type, (1, 1))) for joint in spec.joints]
    for key in spec.keys:
        key.qpos = _with_free_joints(list(key.qpos), [(is_free, nq) for is_free, nq, _ in joints], _REST_POSE)
        key.qvel = _with_free_joints(list(key.qvel), [(is_free, nv) for is_free, _, nv in joints], _REST_VELOCITY)
        key.mpos = []
        key.mquat = []


_REST_POSE: Final = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
_REST_VELOCITY: Final = (0.0,) * 6


def _with_free_joints(values: list[float], joints: list[tuple[bool, int]], block: Sequence[float]) -> list[float]:
    """Return `values` with `block` put in for each free joint, if it has exactly the other joints' coordinates."""
    if not values or len(values) != sum(width for is_free, width in joints if not is_free):
        return values
    complete: list[float] = []
    position = 0
    for is_free, width in joints:
        if is_free:
            complete += block
        else:
            complete += values[position : position + width]
            position += width
    return complete
