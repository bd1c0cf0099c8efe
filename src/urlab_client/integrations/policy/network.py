"""A network in an ONNX file: what goes in, what comes out, and running it."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from urlab_client._extras import need
from urlab_client.integrations.policy.spec import PolicyFileError
from urlab_client.protocol.base import Floats

__all__ = ["Entry", "Network", "OnnxDictNetwork", "OnnxInputs", "OnnxNetwork", "PicturesNetwork"]


_BYTES: Final = "tensor(uint8)"


class Network(Protocol):
    """What turns an observation into outputs; any callable of this kind will do."""

    def __call__(self, observation: Floats, /) -> Floats:
        """Return the outputs, shape (n_outputs,), for an observation, shape (n_inputs,)."""
        ...


class PicturesNetwork(Protocol):
    """What turns inputs with names, pictures among them, into outputs; any callable of this kind will do."""

    def __call__(self, inputs: Mapping[str, NDArray[Any]], /) -> Floats:
        """Return the outputs, shape (n_outputs,), for the inputs of a declaration by name."""
        ...


class Entry(Protocol):
    """What an input is to hold: a space of Gymnasium's is one."""

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Its shape."""
        ...

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """Its type; numbers of any width are fed as float32."""
        ...


class OnnxNetwork:
    """A network with one input and one output of numbers, run by ONNX Runtime on one thread.

    Attributes:
        path: The file.
        inputs: Numbers that go in, or None when the file leaves it open.
        outputs: Numbers that come out, or None when the file leaves it open.
    """

    def __init__(self, path: Path) -> None:
        """Load a file.

        Raises:
            PolicyFileError: It is missing, no ONNX file, or has other inputs and outputs than one of each.
            ImportError: The extra `onnx` is not installed.
        """
        self._session = _session(path)
        ends = {"input": self._session.get_inputs(), "output": self._session.get_outputs()}
        for kind, found in ends.items():
            if len(found) != 1 or found[0].type != "tensor(float)" or not 1 <= len(found[0].shape) <= 2:
                raise PolicyFileError(
                    f"{path}: it needs one {kind}, float32 of shape [n] or [batch, n]; it has: {_told(found)}.",
                    hint="A declaration for a network with several inputs names the `input` of each term.",
                )
        self.path = path
        self._input = ends["input"][0].name
        self._batched = len(ends["input"][0].shape) == 2
        self.inputs: int | None = _width(ends["input"][0].shape)
        self.outputs: int | None = _width(ends["output"][0].shape)

    def __call__(self, observation: Floats, /) -> Floats:
        """See `Network`."""
        fed = np.asarray(observation, dtype=np.float32)
        (outputs,) = self._session.run(None, {self._input: fed[None] if self._batched else fed})
        return np.asarray(outputs, dtype=np.float64).reshape(-1)


class OnnxInputs:
    """A network in an ONNX file whose inputs are told apart by name, run by ONNX Runtime on one thread.

    Each input has the shape of what it sees behind an axis for the batch; pictures are uint8, numbers float32.

    Attributes:
        path: The file.
        inputs: Names of its inputs.
    """

    def __init__(self, path: Path) -> None:
        """Load a file.

        Raises:
            PolicyFileError: It is missing, or no ONNX file.
            ImportError: The extra `onnx` is not installed.
        """
        self._session = _session(path)
        self.path = path
        self._types = {one.name: np.uint8 if one.type == _BYTES else np.float32 for one in self._session.get_inputs()}
        self.inputs: tuple[str, ...] = tuple(self._types)

    def require(self, entries: Mapping[str, Entry], outputs: int) -> None:
        """Check that it sees some of the entries, and returns so many numbers.

        Raises:
            PolicyFileError: It does not.
        """
        made = self._session.get_outputs()
        for one in self._session.get_inputs():
            entry = entries.get(one.name)
            if entry is None:
                raise PolicyFileError(
                    f"{self.path}: its input {one.name!r} is not an entry of the observation; there are: "
                    f"{', '.join(entries)}."
                )
            wanted = _BYTES if entry.dtype == np.uint8 else "tensor(float)"
            sizes = list(entry.shape or ())
            if one.type != wanted or len(one.shape) != 1 + len(sizes) or not _fits(one.shape[1:], sizes):
                raise PolicyFileError(
                    f"{self.path}: its input {one.name!r} must be {wanted} of shape {['batch', *sizes]}, "
                    f"not {one.type} {one.shape}."
                )
        if len(made) != 1 or made[0].type != "tensor(float)" or not _fits(made[0].shape[1:], [outputs]):
            raise PolicyFileError(
                f"{self.path}: it needs one output, float32 of shape ['batch', {outputs}]; it has: {_told(made)}."
            )

    def __call__(self, inputs: Mapping[str, NDArray[Any]], /) -> Floats:
        """See `PicturesNetwork`; further entries are not used."""
        fed = {name: np.asarray(inputs[name], dtype)[None] for name, dtype in self._types.items()}
        (outputs,) = self._session.run(None, fed)
        return np.asarray(outputs[0], dtype=np.float64)


class OnnxDictNetwork:
    """A network in an ONNX file that maps dictionary observations, with pictures for example, to actions.

    Each input has the name of an entry, such as `arm/qpos`, `task` or `cameras/arm/overview`, and its shape behind an
    axis for the batch; pictures are uint8, numbers float32. Entries that no input is named after are not used. The only
    output is the action of the only articulation that is driven.

    Attributes:
        path: The file.
        inputs: Names of the entries that it sees.
    """

    def __init__(self, path: Path, observation_space: Any, outputs: int) -> None:
        """Load a file.

        Args:
            path: The file.
            observation_space: `single_observation_space` of the environment, a `Dict`.
            outputs: Numbers of an action.

        Raises:
            PolicyFileError: The file is missing, no ONNX file, or does not fit.
            ImportError: The extra `onnx` is not installed.
        """
        self._network = OnnxInputs(path)
        self._network.require(_entries(observation_space), outputs)
        self.path = path
        self.inputs: tuple[str, ...] = self._network.inputs

    def __call__(self, observation: Any, /) -> Floats:
        """Return the action, shape (n,), for the observation of one environment."""
        return self._network(_entries(observation))


def _session(path: Path) -> Any:
    """Return ONNX Runtime's session of a file, on one thread: small networks lose more by threads than they gain."""
    need("onnxruntime", extra="onnx")
    if not path.is_file():
        raise PolicyFileError(f"{path}: no such file.", hint="A policy is a .onnx file and a .toml file beside it.")
    runtime: Any = importlib.import_module("onnxruntime")  # it brings no types
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return runtime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise PolicyFileError(f"{path}: not a network that ONNX Runtime can run: {_line(error)}") from error


def _entries(nested: Any, prefix: str = "") -> dict[str, Any]:
    """Return what a dictionary of dictionaries holds, by names such as `arm/qpos`."""
    found: dict[str, Any] = {}
    for name, entry in nested.items():
        found |= _entries(entry, f"{prefix}{name}/") if hasattr(entry, "items") else {f"{prefix}{name}": entry}
    return found


def _fits(shape: list[Any], sizes: list[int]) -> bool:
    """Return whether a shape, whose open axes are names, can be of these sizes."""
    return len(shape) == len(sizes) and all(
        one in (size, None) or isinstance(one, str) for one, size in zip(shape, sizes, strict=True)
    )


def _told(ends: list[Any]) -> str:
    return ", ".join(f"{end.name} {end.type} {end.shape}" for end in ends)


def _width(shape: list[Any]) -> int | None:
    return shape[-1] if isinstance(shape[-1], int) else None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
