"""The simulated server's own part of a direct step: `mj_step` and a round trip are the floor."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import mujoco

from benchmarks.canned import Requester, server
from benchmarks.harness import Burst, Pair, Row
from benchmarks.robots import recorded, robot_mjcf
from urlab_client.protocol.codec import decode_reply, encode_request, op_of
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.protocol.messages.session import Hello, HelloOk, Reset, Step

__all__ = ["ROWS"]

_JOINTS = 29


class _Simulated:
    """A session with a simulated server in a process of its own, spoken to with bytes alone."""

    def __init__(self, requester: Requester) -> None:
        self.requester = requester
        hello = decode_reply(op_of(Hello), HelloOk, requester.ask(encode_request(Hello(), "")))
        self.session_id = hello.session_id
        assert hello.mjb is not None  # noqa: S101
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.mjb"
            path.write_bytes(hello.mjb)
            self.model = mujoco.MjModel.from_binary_path(str(path))
        requester.ask(encode_request(SetMode(mode="direct"), self.session_id))

    def resetting(self) -> Callable[[], bytes]:
        """Return what brings physics to its start: how long a step takes depends on what the robot does."""
        return self.requester.asking(encode_request(Reset(), self.session_id))

    def stepping(self, n_steps: int) -> Callable[[], bytes]:
        """Return what asks for so many steps."""
        return self.requester.asking(encode_request(Step(n_steps=n_steps), self.session_id))


@contextlib.contextmanager
def _simulated(*, standing: bool = True) -> Iterator[_Simulated]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(robot_mjcf(_JOINTS, standing=standing))
        ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
        command = [sys.executable, "-m", "urlab_client", "serve", str(path), "--play", "--json", "--until-eof", *ports]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
            try:
                port = msgspec.json.decode(process.stdout.readline())["step_port"]
                with Requester(port) as requester:
                    yield _Simulated(requester)
            finally:
                process.stdin.close()


def _from_start(reset: Callable[[], object], step: Callable[[], object]) -> Burst:
    def burst(count: int) -> list[float]:
        clock = time.perf_counter
        reset()
        times: list[float] = []
        for _ in range(count):
            started = clock()
            step()
            times.append(clock() - started)
        return times

    return burst


@contextlib.contextmanager
def _single(*, standing: bool = True) -> Iterator[Pair]:
    with _simulated(standing=standing) as ours, server(recorded(_JOINTS)) as port, Requester(port) as floor:
        data = mujoco.MjData(ours.model)
        ask = floor.asking(encode_request(Step(), ours.session_id))

        def physics_and_round_trip() -> None:
            mujoco.mj_step(ours.model, data)
            ask()

        yield Pair(
            ours=_from_start(ours.resetting(), ours.stepping(1)),
            floor=_from_start(lambda: mujoco.mj_resetData(ours.model, data), physics_and_round_trip),
        )


@contextlib.contextmanager
def _hundred() -> Iterator[Pair]:
    with _simulated() as ours:
        data = mujoco.MjData(ours.model)

        def physics() -> None:
            for _ in range(100):
                mujoco.mj_step(ours.model, data)

        yield Pair(
            ours=_from_start(ours.resetting(), ours.stepping(100)),
            floor=_from_start(lambda: mujoco.mj_resetData(ours.model, data), physics),
        )


_ROBOT = "robot of 29 joints and a free base"

ROWS = (
    Row(
        name="server-step-1",
        what=f"simulated server, direct, n_steps=1, {_ROBOT} standing on the ground",
        floor="mj_step + blocking REQ round trip of the same bytes",
        reach=1.35,
        prepare=_single,
        count=100,
    ),
    Row(
        name="server-step-1-falling",
        what="the same robot in free fall, where physics has least to do",
        floor="mj_step + blocking REQ round trip of the same bytes",
        reach=1.35,
        prepare=lambda: _single(standing=False),
        count=100,
    ),
    Row(
        name="server-step-100",
        what="simulated server, direct, n_steps=100, the robot standing",
        floor="100 x mj_step in a loop",
        reach=0.95,
        kind="rate",
        prepare=_hundred,
        count=5,
    ),
)
