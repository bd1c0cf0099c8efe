"""A network in an ONNX file: its inputs, its outputs, writing and running it."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from urlab_client._installation import need
from urlab_client.integrations.policy.spec import PolicyFileError
from urlab_client.protocol.base import Floats

_BYTES: Final = "tensor(uint8)"


Network: TypeAlias = Callable[[Floats], Floats]
"""Maps an observation, shape (n_inputs,), to outputs, shape (n_outputs,)."""

Layer: TypeAlias = tuple[str, Sequence[Any], Mapping[str, Any]]
"""An ONNX operator, the constants that it takes after the value, and its attributes."""

PicturesNetwork: TypeAlias = Callable[[Mapping[str, NDArray[Any]]], Floats]
"""Maps named inputs, which may include pictures, to outputs, shape (n_outputs,)."""


class OnnxNetwork:
    """A network with one numeric input and one numeric output, run by ONNX Runtime on one thread.

    Attributes:
        path: The file.
        inputs: Size of the input, or None if the file does not fix it.
        outputs: Size of the output, or None if the file does not fix it.
    """

    def __init__(self, path: Path) -> None:
        """Load a file.

        Raises:
            PolicyFileError: The file is missing, is not an ONNX file, or does not have exactly one input and one
                output.
            ImportError: The extra `onnx` is not installed.
        """
        self._session = _session(path)
        ends = {"input": self._session.get_inputs(), "output": self._session.get_outputs()}
        for kind, found in ends.items():
            if len(found) != 1 or found[0].type != "tensor(float)" or not 1 <= len(found[0].shape) <= 2:
                raise PolicyFileError(
                    f"{path}: it needs one {kind}, float32 of shape [n] or [batch, n]; it has: {_described(found)}.",
                    hint="If the network has several inputs, declare the `input` of each term.",
                )
        self.path = path
        self._input = ends["input"][0].name
        self._batched = len(ends["input"][0].shape) == 2
        self.inputs: int | None = _width(ends["input"][0].shape)
        self.outputs: int | None = _width(ends["output"][0].shape)

    def __call__(self, observation: Floats, /) -> Floats:
        """Return the outputs, shape (n_outputs,), for an observation, shape (n_inputs,)."""
        fed = np.asarray(observation, dtype=np.float32)
        (outputs,) = self._session.run(None, {self._input: fed[None] if self._batched else fed})
        return np.asarray(outputs, dtype=np.float64).reshape(-1)


class OnnxInputs:
    """A network in an ONNX file with named inputs, run by ONNX Runtime on one thread.

    Each input has a batch axis followed by the shape of its entry. Pictures are uint8, numbers are float32.

    Attributes:
        path: The file.
        inputs: Names of the inputs.
    """

    def __init__(self, path: Path) -> None:
        """Load a file.

        Raises:
            PolicyFileError: The file is missing or is not an ONNX file.
            ImportError: The extra `onnx` is not installed.
        """
        self._session = _session(path)
        self.path = path
        self._types = {one.name: np.uint8 if one.type == _BYTES else np.float32 for one in self._session.get_inputs()}
        self.inputs: tuple[str, ...] = tuple(self._types)

    def require(self, entries: Mapping[str, Any], outputs: int) -> None:
        """Check that the inputs are among the entries, and that the network has the given number of outputs.

        Args:
            entries: What there is for inputs, by name: spaces of Gymnasium, or others with a `shape` and a `dtype`.
            outputs: Number of outputs.

        Raises:
            PolicyFileError: A check fails.
        """
        made = self._session.get_outputs()
        for one in self._session.get_inputs():
            entry = entries.get(one.name)
            if entry is None:
                raise PolicyFileError(
                    f"{self.path}: its input {one.name!r} is not an entry of the observation; the entries are: "
                    f"{', '.join(entries)}."
                )
            wanted = _BYTES if entry.dtype == np.uint8 else "tensor(float)"
            sizes: list[int] = [*(entry.shape or ())]
            if one.type != wanted or len(one.shape) != 1 + len(sizes) or not _fits(one.shape[1:], sizes):
                raise PolicyFileError(
                    f"{self.path}: its input {one.name!r} must be {wanted} of shape {['batch', *sizes]}, "
                    f"not {one.type} {one.shape}."
                )
        if len(made) != 1 or made[0].type != "tensor(float)" or not _fits(made[0].shape[1:], [outputs]):
            raise PolicyFileError(
                f"{self.path}: it needs one output, float32 of shape ['batch', {outputs}]; it has: {_described(made)}."
            )

    def __call__(self, inputs: Mapping[str, NDArray[Any]], /) -> Floats:
        """Return the outputs, shape (n_outputs,), for inputs by name; further ones are ignored."""
        fed = {name: np.asarray(inputs[name], dtype)[None] for name, dtype in self._types.items()}
        (outputs,) = self._session.run(None, fed)
        return np.asarray(outputs[0], dtype=np.float64)


class OnnxDictNetwork(OnnxInputs):
    """A network in an ONNX file that maps dictionary observations, which may include pictures, to actions.

    Each input is named after an entry, such as `arm/qpos`, `task` or `cameras/arm/overview`. Entries without an input
    are ignored. The only output is the action of the only articulation with actuators.
    """

    def __init__(self, path: Path, observation_space: Any, outputs: int) -> None:
        """Load a file.

        Args:
            path: The file.
            observation_space: `single_observation_space` of the environment, a `Dict`.
            outputs: Size of an action.

        Raises:
            PolicyFileError: The file is missing, is not an ONNX file, or does not fit the environment.
            ImportError: The extra `onnx` is not installed.
        """
        super().__init__(path)
        self.require(_entries(observation_space), outputs)

    def __call__(self, observation: Any, /) -> Floats:
        """Return the action, shape (n,), for the observation of one environment."""
        return super().__call__(_entries(observation))


def task_network(path: Path, observation_space: Any, action_space: Any, history: int = 1) -> Network | OnnxDictNetwork:
    """Return the network in an ONNX file that maps the observations of an environment to its actions.

    Args:
        path: The file.
        observation_space: `single_observation_space` of the environment, flat or a `Dict`.
        action_space: Its `single_action_space`.
        history: Number of observations in one input, oldest first, if they are flat.

    Raises:
        PolicyFileError: The file is missing, is not an ONNX file, or does not fit the environment.
        ImportError: The extra `onnx` is not installed.
    """
    if hasattr(observation_space, "spaces"):
        ((_, box),) = action_space.items()
        return OnnxDictNetwork(path, observation_space, len(box.low))
    network = OnnxNetwork(path)
    for name, size in (("inputs", history * observation_space.shape[0]), ("outputs", action_space.shape[0])):
        if getattr(network, name) not in (None, size):
            raise PolicyFileError(f"{path} has {getattr(network, name)} {name}, but the task has {size}.")
    return network


def onnx_network(layers: Sequence[Layer], inputs: int) -> bytes:
    """Return an ONNX file of a network that maps observations, shape (batch, inputs), to actions.

    Args:
        layers: What happens to an observation, in order. Besides ONNX's operators there is `Swish`.
        inputs: Length of an observation.

    Raises:
        MissingExtra: The extra `train` is not installed.
    """
    need("onnx", extra="train")
    onnx: Any = importlib.import_module("onnx")
    make, float32 = onnx.helper, onnx.TensorProto.FLOAT
    nodes: list[Any] = []
    constants: list[Any] = []
    value = "observation"
    for index, (operator, arrays, attributes) in enumerate(layers):
        result = "action" if index == len(layers) - 1 else f"value{index}"
        names = [f"{operator}{index}_{number}" for number in range(len(arrays))]
        for name, array in zip(names, map(np.asarray, arrays), strict=True):
            exact = array if array.dtype.kind == "i" else array.astype(np.float32)
            constants.append(onnx.numpy_helper.from_array(exact, name))
        if operator == "Swish":
            nodes.append(make.make_node("Sigmoid", [value], [f"gate{index}"]))
            names = [f"gate{index}"]
        kind = "Mul" if operator == "Swish" else operator
        nodes.append(make.make_node(kind, [value, *names], [result], **attributes))
        value = result
    ends = [
        [make.make_tensor_value_info(name, float32, ["batch", width])]
        for name, width in (("observation", inputs), ("action", None))
    ]
    graph = make.make_graph(nodes, "policy", *ends, constants)
    opsets = [make.make_opsetid("", 20)]
    made = make.make_model(graph, producer_name="urlab_client", opset_imports=opsets, ir_version=9)
    onnx.checker.check_model(made, full_check=True)
    return made.SerializeToString()


def _session(path: Path) -> Any:
    """Return an ONNX Runtime session of a file, on one thread: more threads slow small networks down."""
    need("onnxruntime", extra="onnx")
    if not path.is_file():
        raise PolicyFileError(f"{path}: no such file.", hint="A policy is a .onnx file with a .toml file beside it.")
    runtime: Any = importlib.import_module("onnxruntime")  # it has no type stubs
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return runtime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise PolicyFileError(f"{path}: not a network that ONNX Runtime can run: {_line(error)}") from error


def _entries(nested: Any, prefix: str = "") -> dict[str, Any]:
    """Return the entries of a nested dictionary, by names such as `arm/qpos`."""
    found: dict[str, Any] = {}
    for name, entry in nested.items():
        found |= _entries(entry, f"{prefix}{name}/") if hasattr(entry, "items") else {f"{prefix}{name}": entry}
    return found


def _fits(shape: list[Any], sizes: list[int]) -> bool:
    """Return whether a shape, whose dynamic axes are names, matches these sizes."""
    return len(shape) == len(sizes) and all(
        one in (size, None) or isinstance(one, str) for one, size in zip(shape, sizes, strict=True)
    )


def _described(ends: list[Any]) -> str:
    return ", ".join(f"{end.name} {end.type} {end.shape}" for end in ends)


def _width(shape: list[Any]) -> int | None:
    return shape[-1] if isinstance(shape[-1], int) else None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
