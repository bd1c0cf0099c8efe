"""Pictures as PNG and JPEG."""

from __future__ import annotations

import io
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image

from urlab_client._installation import MissingExtra
from urlab_client.protocol.messages.streams import CameraSample


def sample(mode: str, pixels: Any) -> CameraSample:
    return CameraSample(camera="eye", mode=mode, pixels=pixels)


def read(data: bytes) -> tuple[str, np.ndarray[Any, Any]]:
    image = Image.open(io.BytesIO(data))
    return str(image.format), np.asarray(image)


COLOURS = np.arange(6 * 8 * 4, dtype=np.uint8).reshape(6, 8, 4)


@pytest.mark.parametrize(("mode", "order"), [("real", [0, 1, 2]), ("semantic", [2, 1, 0]), ("instance", [2, 1, 0])])
def test_a_png_has_the_colours_exactly(mode: str, order: list[int]) -> None:
    kind, image = read(sample(mode, COLOURS).png())
    assert kind == "PNG"
    assert np.array_equal(image, COLOURS[..., order])


def test_a_png_of_depth_is_in_millimetres() -> None:
    depth = np.array([[0.001, 1.2344, 65.534], [65.535, np.inf, np.nan]], np.float32)
    _, image = read(sample("depth", depth).png())
    assert image.astype(int).tolist() == [[1, 1234, 65534], [0, 0, 0]]


def test_a_jpeg_is_to_be_looked_at() -> None:
    red = np.zeros((16, 16, 4), np.uint8)
    red[..., 0], red[..., 3] = 250, 255
    kind, image = read(sample("real", red).jpeg())
    assert kind == "JPEG"
    assert image[8, 8, 0] > 200 > 50 > image[8, 8, 2]
    noise = np.random.default_rng(1).integers(0, 256, (64, 64, 4), dtype=np.uint8)
    assert len(sample("real", noise).jpeg(20)) < len(sample("real", noise).jpeg(95))
    _, image = read(sample("depth", np.linspace(1, 5, 256, dtype=np.float32).reshape(16, 16)).jpeg())
    assert image[0, 0] > image[15, 15], "near is bright"
    for quality in (0, 101):
        with pytest.raises(ValueError, match="1 to 100"):
            sample("real", red).jpeg(quality)


def test_without_pillow_the_error_has_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r"PIL is not installed; run: .*pillow"):
        sample("real", COLOURS).png()
