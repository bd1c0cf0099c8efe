"""Golden bytes of the wire, from the files in `data`, one for each generation of the plugin.

Test directories are no packages: pytest puts each on `sys.path`, so test modules need unique names and import this
one as `import vectors`, or take the `vector` fixture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np


class Vector(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One golden example.

    Attributes:
        name: Unique name.
        hex: All bytes; of a multi-frame message, its frames joined.
        origin: `plugin` (it sends or must read these bytes), `client` (a client sends them), `derived` (own text in
            free-form places) or the name of a later server (it sends them).
        expect: Whether a reader must `accept` or `reject` the bytes.
        decoded: What the bytes mean; for a reject, the `reason`.
        frames_hex: The frames of a multi-frame message.
        note: Remark for readers.
    """

    name: str
    hex: str
    origin: str
    expect: str
    decoded: dict[str, Any]
    frames_hex: list[str] = []
    note: str = ""

    @property
    def data(self) -> bytes:
        return bytes.fromhex(self.hex)

    @property
    def frames(self) -> list[bytes]:
        return [bytes.fromhex(frame) for frame in self.frames_hex]


_FILES = {"alpha": "vectors.json", "june": "vectors-2.json", "beta": "vectors-beta.json"}


def _read(file: str) -> dict[str, Vector]:
    found = msgspec.json.decode((Path(__file__).parent / "data" / file).read_bytes(), type=list[Vector])
    return {vector.name: vector for vector in found}


_VECTORS = {generation: _read(file) for generation, file in _FILES.items()}


def load(name: str, generation: str = "alpha") -> Vector:
    return _VECTORS[generation][name]


def all(generation: str = "alpha") -> list[Vector]:  # noqa: A001
    return list(_VECTORS[generation].values())


def encode_camera(pixels: np.ndarray, mode: str) -> bytes:
    """Return a picture as servers send it: depths in centimetres, colours as BGRA with alpha 255, the rest as it is."""
    if mode == "depth":
        with np.errstate(over="ignore"):
            return (pixels * np.float32(100)).astype("<f4").tobytes()
    if mode != "real":
        return pixels.tobytes()
    sent = pixels[..., [2, 1, 0, 3]]
    sent[..., 3] = 255
    return sent.tobytes()
