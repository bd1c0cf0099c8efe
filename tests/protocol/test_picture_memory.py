from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest

from urlab_client.values.pictures import PictureMemory, Pixels, decode_camera

MODES = ["real", "semantic", "depth"]
SIDE = 256
SIZE = 4 * SIDE * SIDE


def picture(memory: PictureMemory, mode: str = "real", fill: int = 64) -> Pixels:
    return decode_camera(bytes([fill]) * SIZE, mode, SIDE, SIDE, memory=memory).pixels


@pytest.mark.parametrize("mode", MODES)
def test_memory_is_used_again_once_nobody_has_a_view_of_it(mode: str) -> None:
    memory = PictureMemory()
    first = picture(memory, mode)
    address = first.ctypes.data
    view = first[1:, ::2].T
    before = view.copy()
    del first
    assert picture(memory, mode, 65).ctypes.data != address
    np.testing.assert_array_equal(view, before)
    del view
    assert address in {picture(memory, mode).ctypes.data for _ in range(2)}


@pytest.mark.parametrize("mode", MODES)
def test_pictures_are_the_users_to_write_to_and_to_keep(mode: str) -> None:
    memory = PictureMemory()
    pictures = [picture(memory, mode, fill) for fill in range(8)]
    assert not any(np.shares_memory(a, b) for a in pictures for b in pictures if a is not b)
    del memory
    pictures[0][:] = 7
    assert [p.reshape(-1)[0] for p in pictures[1:]] == [
        decode_camera(bytes([fill]) * 4, mode, 1, 1).pixels.reshape(-1)[0] for fill in range(1, 8)
    ]


def test_another_size_is_other_memory() -> None:
    memory = PictureMemory()
    picture(memory)
    assert decode_camera(bytes(24), "real", 3, 2, memory=memory).pixels.shape == (2, 3, 4)


def test_of_memory_that_nobody_uses_two_pictures_are_kept() -> None:
    memory = PictureMemory()
    tracemalloc.start()
    try:
        pictures = [picture(memory) for _ in range(5)]
        del pictures
        gc.collect()
        assert 2 * SIZE <= tracemalloc.get_traced_memory()[0] < 3 * SIZE
    finally:
        tracemalloc.stop()
