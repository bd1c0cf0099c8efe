"""The simulated server's own part of a direct step: `mj_step` and a round trip are the floor."""

from __future__ import annotations

import contextlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import msgspec
import mujoco

from benchmarks.canned import PROCESSOR_S, Requester, server
from benchmarks.conditions import warm
from benchmarks.harness import Burst, Figure, Pair, Row
from benchmarks.robots import dialect, humanoid, recorded_of, robot_mjcf
from urlab_client.protocol.codec import decode_reply, encode_request, op_of
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.protocol.messages.session import Hello, HelloOk, Reset, Step

__all__ = ["ROWS"]
"""What the simulated servers of these rows speak; rows may run in processes of their own."""

_JOINTS = 29
_ROUNDS = 10
_STEPS = 100


class _Simulated:
    """A session with a simulated server in a process of its own, spoken to with bytes alone."""

    def __init__(self, requester: Requester, process: int) -> None:
        self.requester = requester
        self.process = process
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
def _robot(*, standing: bool) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(robot_mjcf(_JOINTS, standing=standing))
        yield path


@contextlib.contextmanager
def _simulated(path: Path) -> Iterator[_Simulated]:
    ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    command = [
        sys.executable,
        "-m",
        "urlab_client",
        "serve",
        str(path),
        "--mjcf-options",
        "--play",
        "--json",
        "--until-eof",
        f"--dialect={dialect()}",
        *ports,
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stdout is not None  # noqa: S101, PT018
        try:
            port = msgspec.json.decode(process.stdout.readline())["step_port"]
            with Requester(port) as requester:
                yield _Simulated(requester, process.pid)
        finally:
            process.stdin.close()


def _processor_s(process: int) -> float | None:
    """Return the processor time of all threads of a process so far; None where the system does not tell."""
    try:
        stats = [path.read_text() for path in Path(f"/proc/{process}/task").glob("*/schedstat")]
    except OSError:
        return None
    return sum(int(text.split()[0]) for text in stats) / 1e9 if stats else None


def _processor_figures(simulated: _Simulated, floor: Requester, ask: Callable[[], bytes]) -> list[Figure]:
    """Return what a step takes the server's process beyond `mj_step`, all its threads and ZeroMQ's counted.

    And what an answer takes a server that does nothing else: sockets and ZeroMQ's threads.
    """
    step, reset = simulated.stepping(1), simulated.resetting()
    data = mujoco.MjData(simulated.model)
    spent: list[float] = []
    answering: list[float] = []
    for _ in range(_ROUNDS):
        idle = _told_processor_s(floor)
        for _ in range(_STEPS):
            ask()
        answering.append((_told_processor_s(floor) - idle) / _STEPS)
        reset()
        mujoco.mj_resetData(simulated.model, data)
        before = _processor_s(simulated.process)
        for _ in range(_STEPS):
            step()
        after = _processor_s(simulated.process)
        if before is None or after is None:
            return []
        physics = time.thread_time()
        for _ in range(_STEPS):
            mujoco.mj_step(simulated.model, data)
        spent.append((after - before - (time.thread_time() - physics)) / _STEPS)
    return [
        Figure(name="processor time of a step beyond mj_step, µs", value=1e6 * statistics.median(spent)),
        Figure(name="of an answer of the floor's server, µs", value=1e6 * statistics.median(answering)),
    ]


def _told_processor_s(server: Requester) -> float:
    return msgspec.msgpack.decode(server.ask(PROCESSOR_S), type=float)


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
def _single(robot: AbstractContextManager[Path]) -> Iterator[Pair]:
    with (
        robot as path,
        _simulated(path) as ours,
        server(recorded_of(path)) as port,
        Requester(port) as floor,
    ):
        data = mujoco.MjData(ours.model)
        ask = floor.asking(encode_request(Step(), ours.session_id))

        def physics_and_round_trip() -> None:
            mujoco.mj_step(ours.model, data)
            ask()

        yield Pair(
            ours=_from_start(ours.resetting(), ours.stepping(1)),
            floor=_from_start(lambda: mujoco.mj_resetData(ours.model, data), physics_and_round_trip),
            figures=lambda: _processor_figures(ours, floor, ask),
        )


@contextlib.contextmanager
def _hundred(robot: AbstractContextManager[Path]) -> Iterator[Pair]:
    with robot as path, _simulated(path) as ours:
        data = mujoco.MjData(ours.model)

        def physics() -> None:
            for _ in range(100):
                mujoco.mj_step(ours.model, data)

        yield Pair(
            ours=_from_start(ours.resetting(), ours.stepping(100)),
            floor=_from_start(lambda: mujoco.mj_resetData(ours.model, data), physics),
        )


_LIGHT = "a robot of 29 joints and a free base"


def _rows(
    suffix: str, robot: str, make: Callable[[], AbstractContextManager[Path]], *, hundred: float = 0.8
) -> tuple[Row, Row]:
    return (
        Row(
            name=f"server-step-1{suffix}",
            what=f"simulated server, direct, n_steps=1, {robot}",
            floor="mj_step + blocking REQ round trip of the same bytes",
            reach=1.5,
            prepare=lambda: _single(make()),
            count=100,
        ),
        Row(
            name=f"server-step-100{suffix}",
            what=f"the same, n_steps=100, {robot}",
            floor="100 x mj_step in a loop",
            reach=hundred,
            kind="rate",
            prepare=lambda: _hundred(make()),
            count=5,
        ),
    )


_HUMANOID = _rows("", "Gymnasium's humanoid", lambda: contextlib.nullcontext(humanoid()), hundred=0.9)

ROWS = (
    *_HUMANOID,
    warm(_HUMANOID[0], reach=1.5),
    # What the server adds is the same for all of them: the less there is to compute, the more it weighs.
    *_rows("-light", f"{_LIGHT} standing on the ground", lambda: _robot(standing=True)),
    *_rows("-falling", f"{_LIGHT} in free fall", lambda: _robot(standing=False)),
)
