"""Gymnasium environments over a simulated server, against Gymnasium's own of the same robot and as many substeps."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.harness import Burst, Figure, Pair, Row
from benchmarks.machine import children, processor_s
from benchmarks.robots import dialect, humanoid

__all__ = ["ROWS"]

_OWN = "Humanoid-v5"
_SUBSTEPS = 5  # as Gymnasium's takes
_SERVERS = 4
_BATCH = 16
_PROCESSOR_S = 2.0  # that figures per core are taken from
_MORE = 256  # copies by which the memory of one is measured


def _stepping(environment: Any, copies: int = 1) -> Burst:
    """Return seconds per step of one environment, from the same start each time."""
    action = 0 * environment.action_space.sample()

    def burst(count: int) -> list[float]:
        environment.reset(seed=0)
        started = time.perf_counter()
        for _ in range(count):
            environment.step(action)
        return [(time.perf_counter() - started) / count / copies]

    return burst


def _own(copies: int | None = None) -> Any:
    import gymnasium  # noqa: PLC0415  # an extra

    if copies is None:
        return gymnasium.make(_OWN, terminate_when_unhealthy=False)
    return gymnasium.make_vec(_OWN, copies, vectorization_mode="sync", terminate_when_unhealthy=False)


@contextlib.contextmanager
def _against(
    ours: Callable[[], Any],
    copies: int,
    own_copies: int | None,
    figures: Callable[[], Sequence[Figure]] = tuple,
) -> Iterator[Pair]:
    with contextlib.closing(ours()) as environment, contextlib.closing(_own(own_copies)) as own:
        yield Pair(
            ours=_stepping(environment, copies),
            floor=_stepping(own, own_copies or 1),
            figures=lambda: [
                Figure(name="steps per second of a core, with the servers'", value=_per_core(environment, copies)),
                Figure(name="the floor's", value=_per_core(own, own_copies or 1)),
                *figures(),
            ],
        )


@contextlib.contextmanager
def _beside_its_client() -> Iterator[Pair]:
    """The processor time of this process for a step of an environment, and for a step of its client."""
    with contextlib.closing(_single()) as environment:
        action = 0 * environment.action_space.sample()
        environment.reset(seed=0)

        def processor_times(operation: Callable[[], object]) -> Burst:
            def burst(count: int) -> list[float]:
                busy = time.process_time()
                for _ in range(count):
                    operation()
                return [(time.process_time() - busy) / count]

            return burst

        yield Pair(
            ours=processor_times(lambda: environment.step(action)),
            floor=processor_times(lambda: environment.client.step(_SUBSTEPS)),
        )


def _per_core(environment: Any, copies: int) -> float:
    """Return steps for each second of processor time, of this process with all its threads and of its children."""
    action = 0 * environment.action_space.sample()
    environment.reset(seed=0)
    taken, started = 0, processor_s()
    while (used := processor_s() - started) < _PROCESSOR_S:
        for _ in range(20):
            environment.step(action)
        taken += 20 * copies
    return taken / used


def _proportional(process: int | str) -> float:
    """Return the memory of a process in MB, shared pages divided among those that share them; 0 where unknown."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{process}/smaps_rollup").read_text(encoding="ascii").splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) / 1024
    return 0.0


def _of_servers() -> list[Figure]:
    """Return the memory of a server, of those that run."""
    used = [_proportional(child) for child in children()]
    return [Figure(name="MB of a server", value=sum(used) / max(len(used), 1))]


def _of_copies() -> list[Figure]:
    """Return what each further copy of a batch takes."""
    from urlab_client.integrations.gym import URLabBatchEnv  # noqa: PLC0415  # an extra

    with contextlib.closing(URLabBatchEnv(_address(), _BATCH, n_substeps=_SUBSTEPS)) as few:
        few.reset(seed=0)
        before = _proportional(os.getpid())
        with contextlib.closing(URLabBatchEnv(_address(), _BATCH + _MORE, n_substeps=_SUBSTEPS)) as many:
            many.reset(seed=0)
            many.step(0 * many.action_space.sample())
            return [Figure(name="MB of a copy", value=(_proportional(os.getpid()) - before) / _MORE)]


def _address() -> str:
    chosen = "" if dialect() == "alpha" else f"?dialect={dialect()}"  # older packages have no such option
    return f"sim://{humanoid()}{chosen}"


def _single() -> Any:
    from urlab_client.integrations.gym import URLabEnv  # noqa: PLC0415  # an extra

    return URLabEnv.connect(_address(), n_substeps=_SUBSTEPS)


def _vector() -> Any:
    from urlab_client.integrations.gym import URLabVectorEnv  # noqa: PLC0415  # an extra

    return URLabVectorEnv(_address(), _SERVERS, n_substeps=_SUBSTEPS)


def _batch() -> Any:
    from urlab_client.integrations.gym import URLabBatchEnv  # noqa: PLC0415  # an extra

    return URLabBatchEnv(_address(), _BATCH, n_substeps=_SUBSTEPS)


def _rows() -> tuple[Row, ...]:
    # Gymnasium's environments import what draws them.
    if importlib.util.find_spec("gymnasium") is None or importlib.util.find_spec("imageio") is None:
        return ()
    floor = f"Gymnasium's own {_OWN}"
    return (
        Row(
            name="env",
            what=f"steps per second of URLabEnv, the humanoid, {_SUBSTEPS} substeps",
            floor=floor,
            reach=0.35,
            kind="rate",
            prepare=lambda: _against(_single, 1, None, _of_servers),
            count=100,
        ),
        Row(
            name="env-client",
            what="processor time of URLabEnv.step() in its own process",
            floor="that of client.step() with as many substeps",
            reach=2.5,
            prepare=_beside_its_client,
            count=100,
        ),
        Row(
            name="env-4-servers",
            what=f"the same of URLabVectorEnv with {_SERVERS} servers, together",
            floor=floor,
            reach=0.5,
            kind="rate",
            prepare=lambda: _against(_vector, _SERVERS, None, _of_servers),
            count=50,
        ),
        Row(
            name="env-batch-16",
            what=f"the same of URLabBatchEnv with {_BATCH} copies, together",
            floor=f"{_BATCH} of them in Gymnasium's SyncVectorEnv, together",
            reach=1.5,
            kind="rate",
            prepare=lambda: _against(_batch, _BATCH, _BATCH, _of_copies),
            count=20,
        ),
    )


ROWS = _rows()
