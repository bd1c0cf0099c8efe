"""What a delayed camera keeps and shows, by both of its clocks."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from urlab_client.protocol.messages.cameras import CameraDelayInForce
from urlab_client.simulation.cameras import CAPACITY, Instant, Latency

STATE = np.zeros(1)


def latency(delay: float, *, jitter: float = 0.0, clock: str = "sim", fps: float = 0.0, seed: int = 1) -> Latency:
    settings = CameraDelayInForce(delay_s=delay, jitter_s=jitter, clock=clock, on_state_change=True, max_fps=fps)
    return Latency(settings, seed)


def run(late: Latency, steps: int, step_s: float) -> list[int | None]:
    """Let a camera see a state each step, its number; return what it shows at each."""
    shown: list[int | None] = []
    for number in range(steps):
        now = Instant(number * step_s, 100.0 + number)
        if not late.skips(now):
            late.see(number, now, 0.0, STATE)
        past = late.revealed(now)
        shown.append(None if past is None else past.frame_id)
    return shown


def test_the_clocks() -> None:
    assert run(latency(0.03), 6, 0.01) == [None, None, None, 0, 1, 2]
    assert run(latency(2.0, clock="wall"), 6, 0.01) == [None, None, 0, 1, 2, 3]


def test_a_clock_that_stands_still_reveals_nothing() -> None:
    assert set(run(latency(0.03), 50, 0.0)) == {None}


@given(st.floats(0.0, 1.0), st.floats(0.001, 1.0), st.integers(1, 2**31))
def test_what_is_shown_is_as_old_as_asked_for(delay: float, jitter: float, seed: int) -> None:
    step_s = 0.01
    shown = run(latency(delay, jitter=jitter, seed=seed), 100, step_s)
    assert shown == run(latency(delay, jitter=jitter, seed=seed), 100, step_s), "the seed decides"
    numbers = [number for number in shown if number is not None]
    assert numbers == sorted(numbers), "it never goes back"
    for now, number in enumerate(shown):
        if number is not None:
            age = (now - number) * step_s
            assert (
                max(0.0, delay - jitter) - 1e-5 <= age <= delay + jitter + step_s + 1e-5 + (delay + jitter) / CAPACITY
            )


def test_the_past_of_a_camera_nobody_looks_at_is_bounded() -> None:
    late, now = latency(1.0, jitter=0.5), Instant(0.0, 0.0)
    for number in range(20 * CAPACITY):
        now = Instant(number * 0.0002, 0.0)
        if not late.skips(now):
            late.see(number, now, 0.0, STATE)
    assert len(late.past) <= CAPACITY + 2
    past = late.revealed(now)
    assert past is not None
    assert 0.5 <= now.sim - past.at <= 1.51
