"""Compare what `client.step()` costs on two commits, where a machine is too busy for `compare_commits.py`.

    python tools/compare_steps.py main                     # the working tree against main, every flavour
    python tools/compare_steps.py HEAD~3 HEAD --only facade --seconds 20

Two clients, each in a process of its own with the package of one commit, step in turn, some milliseconds each, against
servers that answer at once. Of these bursts the quicker quarter is compared: it is what other programs have disturbed
least. Two processes that run the very same code differ by up to five percent, by where their memory lies, so all of
that is repeated with new ones; the median of the ratios counts, and their range says how far to trust it. The clients
sleep for their replies, and never look for them (`aio/transport/waiting.py`): that would be compared, too.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import importlib.util
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from compare_commits import ROOT, WORKING_TREE, tree_of

STEPS = 100  # of a burst: some milliseconds
WARM_UP = 10  # bursts
FIGURES = ("processor", "of the caller's thread", "latency")
FLAVOURS = ("aio", "facade", "aio-uvloop", "aio-shm", "facade-shm")
_JOINTS = 29


class Burst(msgspec.Struct):
    """Microseconds of a step: the process's processor time, the thread's, and the median time of a step."""

    processor: float
    thread: float
    latency: float


class Client:
    """A client in a process of its own that steps when it is told."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.bursts: list[Burst] = []
        self._tell()

    def step(self) -> None:
        """Let it step through one burst."""
        assert self._process.stdin is not None  # noqa: S101
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        self.bursts.append(self._tell())

    def _tell(self) -> Burst:
        assert self._process.stdout is not None  # noqa: S101
        return msgspec.json.decode(self._process.stdout.readline(), type=Burst)


@contextlib.contextmanager
def client(tree: Path, flavour: str) -> Iterator[Client]:
    """Run a client with the package of a tree, and a server for it."""
    sys.path.insert(0, str(ROOT))
    from benchmarks.canned import server
    from benchmarks.canned_memory import memory_server
    from benchmarks.robots import recorded

    with contextlib.ExitStack() as stack:
        answers = recorded(_JOINTS)
        if "shm" in flavour:
            directory = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            port = stack.enter_context(memory_server(answers, directory, doorbell=True))
        else:
            port = stack.enter_context(server(answers))
        process = stack.enter_context(
            subprocess.Popen(  # noqa: S603  # ourselves
                [sys.executable, __file__, "--child", flavour, str(port)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                env=os.environ | {"PYTHONPATH": str(tree / "src")},
            )
        )
        yield Client(process)


def quicker_quarter(bursts: Sequence[Burst], figure: Callable[[Burst], float]) -> float:
    """Return the figure below which a quarter of the bursts lie."""
    return sorted(map(figure, bursts))[len(bursts) // 4]


def compare(trees: tuple[Path, Path], flavour: str, seconds: float) -> list[tuple[float, float]]:
    """Return each of `FIGURES` before and after, microseconds of a step."""
    with client(trees[0], flavour) as before, client(trees[1], flavour) as after:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for stepping in (before, after, after, before):  # neither always has the other's aftermath to bear
                stepping.step()
    figures: list[Callable[[Burst], float]] = [lambda b: b.processor, lambda b: b.thread, lambda b: b.latency]
    return [(quicker_quarter(before.bursts, f), quicker_quarter(after.bursts, f)) for f in figures]


# In the child


def _steps(flavour: str, port: str) -> Callable[[], list[float]]:
    """Return what takes a burst of steps and returns the seconds of each."""
    from urlab_client import URLabClient, aio
    from urlab_client._platform import processors

    processors._answer, processors._known_until = True, float("inf")  # noqa: SLF001  # as on a crowded machine
    options: dict[str, Any] = {"step_mode": "direct"} | ({"transport": "shm"} if "shm" in flavour else {})
    clock = time.perf_counter
    if flavour.startswith("facade"):
        blocking = URLabClient(f"tcp://127.0.0.1:{port}", **options)
        blocking.discover()

        def burst() -> list[float]:
            times: list[float] = []
            for _ in range(STEPS):
                started = clock()
                blocking.step()
                times.append(clock() - started)
            return times

        return burst
    runner = asyncio.Runner(loop_factory=_uvloop() if "uvloop" in flavour else None)
    awaited = aio.URLabClient(f"tcp://127.0.0.1:{port}", **options)
    runner.run(awaited.discover())

    async def steps() -> list[float]:
        times: list[float] = []
        for _ in range(STEPS):
            started = clock()
            await awaited.step()
            times.append(clock() - started)
        return times

    return lambda: runner.run(steps())


def _uvloop() -> Callable[[], asyncio.AbstractEventLoop]:
    import uvloop

    return uvloop.new_event_loop


def _child(flavour: str, port: str) -> None:
    burst = _steps(flavour, port)
    for _ in range(WARM_UP):
        burst()
    print(msgspec.json.encode(Burst(0.0, 0.0, 0.0)).decode(), flush=True)
    for _ in sys.stdin:
        processor, thread = time.process_time(), time.thread_time()
        times = burst()
        thread, processor = time.thread_time() - thread, time.process_time() - processor
        taken = Burst(1e6 * processor / STEPS, 1e6 * thread / STEPS, 1e6 * sorted(times)[STEPS // 2])
        print(msgspec.json.encode(taken).decode(), flush=True)
    os._exit(0)  # the servers are gone: there is nobody to take leave of


def main() -> int:
    """Run the command line; return the exit code."""
    if sys.argv[1:2] == ["--child"]:
        _child(*sys.argv[2:])
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", help="commit to compare with")
    parser.add_argument("after", nargs="?", default=WORKING_TREE, help="commit to compare; the %(default)s by default")
    parser.add_argument("--only", action="append", choices=FLAVOURS, help="which clients; repeatable")
    parser.add_argument("--seconds", type=float, default=2.0, help="seconds of each run (%(default)s)")
    parser.add_argument("--runs", type=int, default=5, help="runs of each, with new processes (%(default)s)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        trees = tree_of(options.before, folder / "before"), tree_of(options.after, folder / "after")
        print(f"µs of a step, {options.after} by {options.before}; 1.05 is 5 % more\n")
        print(f"{'client':<12}{'figure':<24}{'before':>8}{'after':>8}{'ratio':>8}")
        for flavour in options.only or FLAVOURS:
            if "uvloop" in flavour and importlib.util.find_spec("uvloop") is None:
                continue
            runs = [compare(trees, flavour, options.seconds) for _ in range(options.runs)]
            for what, pairs in zip(FIGURES, zip(*runs, strict=True), strict=True):
                before, after = (statistics.median(pair[i] for pair in pairs) for i in (0, 1))
                ratios = [after / before for before, after in pairs]
                spread = f"({min(ratios):.2f} - {max(ratios):.2f})"
                print(f"{flavour:<12}{what:<24}{before:>8.1f}{after:>8.1f}{statistics.median(ratios):>8.3f}  {spread}")
            sys.stdout.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main())
