"""A network in an ONNX file: what goes in, what comes out, and running it."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from urlab_client._extras import need
from urlab_client.integrations.policy.spec import PolicyFileError
from urlab_client.protocol.base import Floats

__all__ = ["Network", "OnnxNetwork"]


class Network(Protocol):
    """What turns an observation into outputs; any callable of this kind will do."""

    def __call__(self, observation: Floats, /) -> Floats:
        """Return the outputs, shape (n_outputs,), for an observation, shape (n_inputs,)."""
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
        need("onnxruntime", extra="onnx")
        if not path.is_file():
            raise PolicyFileError(f"{path}: no such file.", hint="A policy is a .onnx file and a .toml file beside it.")
        runtime: Any = importlib.import_module("onnxruntime")  # it brings no types
        options = runtime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = (
            1  # small networks: threads cost more than they do
        )
        options.log_severity_level = 4
        try:
            self._session = runtime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise PolicyFileError(f"{path}: not a network that ONNX Runtime can run: {_line(error)}") from error
        self.path = path
        ends = {"input": self._session.get_inputs(), "output": self._session.get_outputs()}
        for kind, found in ends.items():
            if len(found) != 1 or found[0].type != "tensor(float)" or not 1 <= len(found[0].shape) <= 2:
                there = ", ".join(f"{end.name} {end.type} {end.shape}" for end in found)
                raise PolicyFileError(
                    f"{path}: it needs one {kind}, float32 of shape [n] or [batch, n]; it has: {there}."
                )
        self._input = ends["input"][0].name
        self._batched = len(ends["input"][0].shape) == 2
        self.inputs: int | None = _width(ends["input"][0].shape)
        self.outputs: int | None = _width(ends["output"][0].shape)

    def __call__(self, observation: Floats, /) -> Floats:
        """See `Network`."""
        fed = np.asarray(observation, dtype=np.float32)
        (outputs,) = self._session.run(None, {self._input: fed[None] if self._batched else fed})
        return np.asarray(outputs, dtype=np.float64).reshape(-1)


def _width(shape: list[Any]) -> int | None:
    return shape[-1] if isinstance(shape[-1], int) else None


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
