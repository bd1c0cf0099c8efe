"""The memory barrier: none where the processor keeps order, something callable everywhere else."""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Iterator

import pytest

from urlab_client._platform.processors import no_fence, processor_fence


@pytest.fixture(autouse=True)
def _forget() -> Iterator[None]:
    processor_fence.cache_clear()
    yield
    processor_fence.cache_clear()


@pytest.mark.parametrize("machine", ["x86_64", "AMD64"])
def test_x86_needs_none(monkeypatch: pytest.MonkeyPatch, machine: str) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert processor_fence() is no_fence


def test_other_processors_get_one_that_can_be_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    fence = processor_fence()
    assert fence is not no_fence
    fence()


def test_without_a_library_for_it_a_lock_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(name: str | None) -> ctypes.CDLL:
        raise OSError(name)

    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(ctypes, "CDLL", load)
    processor_fence()()
