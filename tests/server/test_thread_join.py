"""Waits for threads: a deadline that passed while this process was stopped is not a reason to give up at once."""

from __future__ import annotations

import threading

import pytest
from waiting import DEADLINE_S

from urlab_client.server.system.threads import ended, within


@pytest.mark.parametrize("timeout", [1.0, 0.0, -5.0])
def test_there_is_a_second_try_whatever_the_deadline(timeout: float) -> None:
    answers = iter([False, True])
    assert within(timeout, lambda _: next(answers))


def test_it_is_given_up_in_the_end() -> None:
    tries: list[float] = []

    def attempt(seconds: float) -> bool:
        tries.append(seconds)
        return False

    assert not within(1.0, attempt)
    assert sum(tries) == pytest.approx(1.0)


def test_a_thread_that_ends_and_one_that_does_not() -> None:
    release = threading.Event()
    thread = threading.Thread(target=release.wait)
    thread.start()
    try:
        assert not ended(thread, 0.0)
    finally:
        release.set()
    assert ended(thread, DEADLINE_S)
