"""Use clients and servers for long and watch what they hold: `python tools/soak.py --minutes 30`. Linux only.

Four servers, each in a process of its own, and a client for each in this process: two over ZeroMQ and two over shared
memory. Of each two one server runs for as long as the soak, the other one is killed, or told to end, in every round,
mostly while it steps, and started again on the same ports. A round opens and reads streams of state, rows and
pictures, switches modes, steps with pictures, resets, stops and starts play. Another stream of state and one of events
are open all the time.

Prints a table of samples and a verdict: it fails (1) when the memory of a lasting server grows, or what this process
has allocated, when there are always more threads or descriptors in the end than after warming up, or when a client
gave a wrong answer. What this process occupies is printed and not judged: glibc keeps what was freed, in a heap for
each of several threads, so that it grows for long to a bound of its own.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from urlab_client import (
    ClientClosed,
    StreamOverflow,
    URLabClient,
    URLabConnectionError,
    URLabRPCError,
    URLabTimeoutError,
)

WARM_UP = 1 / 3
"""Part of the soak that is not judged: caches fill, allocators learn."""

GROWTH_MIB = 4.0
"""What the fitted line of memory may gain over the rest."""

PATIENCE_S = 60.0
"""Deadlines, so that a machine that is busy with other things is not taken for a fault."""

SHM = "/dev/shm"  # noqa: S108  # a tmpfs; the server makes a private directory below it
PORTS = ("step", "state", "ctrl", "info", "camera")
_BLOCKS = itertools.count(21000, 100)
"""First ports of the servers, among those that the system gives to nobody who asks for any: a server that starts again
must find its own free. That of the cameras is the last, as more follow it."""


@dataclass(kw_only=True)
class Held:
    """What a process holds; what of its memory is allocated is known of this process alone."""

    at: float
    rss_mib: float
    allocated_mib: float | None
    threads: int
    descriptors: int


_MALLINFO2 = (
    *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
    *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
)


class _Mallinfo2(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_size_t) for name in _MALLINFO2)


def allocated_mib() -> float:
    """Return what this process has allocated from glibc and not freed."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = _Mallinfo2
    info = mallinfo2()
    return (info.uordblks + info.hblkhd) / 2**20


def held_by(pid: int, at: float) -> Held:
    """Read what a process holds.

    Raises:
        OSError: It has ended.
    """
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return Held(
        at=at,
        rss_mib=int(status["VmRSS"].split()[0]) / 1024,
        allocated_mib=allocated_mib() if pid == os.getpid() else None,
        threads=int(status["Threads"]),
        descriptors=len(list(Path(f"/proc/{pid}/fd").iterdir())),
    )


class Server:
    """`urlab serve` in a child process, on the same ports each time."""

    def __init__(self, *, shm: bool) -> None:
        self.starts = 0
        self.most = Held(at=0.0, rss_mib=0.0, allocated_mib=None, threads=0, descriptors=0)
        self._shm = shm
        self._ports = dict(zip(PORTS, itertools.count(next(_BLOCKS)), strict=False))
        self.start()

    def start(self) -> None:
        """Start it and wait until it serves."""
        command = [sys.executable, "-m", "urlab_client", "serve", "arm", "--json", "--until-eof", "--play"]
        command += [f"--{name}-port={number}" for name, number in self._ports.items()]
        command += [f"--shm-dir={SHM}"] if self._shm else ["--no-shm"]
        deadline = time.monotonic() + PATIENCE_S
        while True:
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)  # noqa: S603
            if self._process.stdout is None:
                raise TypeError("the server's output must be a pipe")
            line = self._process.stdout.readline()
            if line or time.monotonic() > deadline:
                break
            self._process.wait()  # the one before has one of its ports, for another moment
        self.address = json.loads(line)["address"]
        self.starts += 1

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def client(self) -> URLabClient:
        """Make a client of it."""
        ports = {f"{name}_port": self._ports[name] for name in ("step", "state", "ctrl", "info")}
        transport = "shm" if self._shm else "zmq"
        return URLabClient(
            self.address, **ports, step_mode="live", transport=transport, rcv_timeout_ms=int(PATIENCE_S * 1000)
        )

    def end(self, *, kill: bool) -> None:
        """Kill it, or tell it to end; wait until it has."""
        with suppress(OSError):
            now = held_by(self.pid, 0.0)
            for name in ("rss_mib", "threads", "descriptors"):
                setattr(self.most, name, max(getattr(self.most, name), getattr(now, name)))
        if kill:
            self._process.kill()
        else:
            self._process.terminate()
        self._process.wait(PATIENCE_S)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()


@dataclass
class Pair:
    """A server, its client and what happened to them."""

    name: str
    server: Server
    client: URLabClient
    restarted: bool
    told: Counter[str] = field(default_factory=Counter[str])
    wrong: list[str] = field(default_factory=list[str])

    def rounds(self, stop: threading.Event, pause: float) -> None:
        """Work until told to stop."""
        try:
            with ExitStack() as readers:
                readers.enter_context(self._reader(self._read_state))
                readers.enter_context(self._reader(self._read_events))
                for kill in itertools.cycle([True, False]):
                    if self.restarted and self.told["rounds"]:
                        self._restart(kill=kill)
                    self._round()
                    self.told["rounds"] += 1
                    if stop.wait(pause):
                        break
                self.client.close()  # which ends the readers
        except Exception as error:  # noqa: BLE001 - whatever it is, it is the finding
            self.wrong.append(f"{type(error).__name__}: {error}")
            self.client.close()

    def _round(self) -> None:
        client = self.client
        client.discover()
        client.runtime.set_mode("live")
        client.runtime.set_paused(False)
        with (
            client.state_stream("all") as states,
            client.row_stream("arm") as rows,
            client.articulations["arm"].cameras["wrist"].frames() as pictures,
        ):
            for _ in range(50):
                states.receive()
            for _ in range(20):
                rows.receive()
            for _ in range(5):
                self.told["pictures"] += pictures.receive().pixels.shape == (480, 640, 4)
        client.runtime.set_mode("direct")
        count = client.reset().step
        for number in range(200):
            count += 1
            if client.step(include_cameras=number == 0).step != count:
                self.wrong.append(f"step {client.step_count} instead of {count}")
        self.told["steps"] += 200
        client.scene.snapshot()
        client.sim.stop()
        client.sim.start()
        client.discover()
        client.step()

    def _restart(self, *, kill: bool) -> None:
        """End the server while it steps, start it again; what the client says meanwhile must be true."""
        self.client.runtime.set_mode("direct")
        stepping = threading.Event()
        at_work = threading.Thread(target=self._step_until_lost, args=[stepping])
        at_work.start()
        stepping.wait(PATIENCE_S)
        self.server.end(kill=kill)
        self.server.start()
        at_work.join(PATIENCE_S)
        if at_work.is_alive():
            self.wrong.append("a step outlives its server")
        found = self.client.resync()
        self.told["resynced"] += 1
        if found.session_held:
            self.wrong.append("a new server holds the session of the old one")

    def _step_until_lost(self, stepping: threading.Event) -> None:
        while True:
            try:
                self.client.step(50)
                stepping.set()
            except (URLabConnectionError, URLabRPCError, URLabTimeoutError) as error:
                self.told[type(error).__name__] += 1
                return

    @contextmanager
    def _reader(self, read: Callable[[], None]) -> Iterator[None]:
        def run() -> None:
            with suppress(ClientClosed):
                read()

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        yield
        thread.join(PATIENCE_S)
        if thread.is_alive():
            self.wrong.append("a reader did not end with its client")

    def _read_state(self) -> None:
        with self.client.state_stream("all") as states:
            while True:
                try:
                    self.told["gaps"] += states.receive(timeout=None).gap is not None
                    self.told["snapshots"] += 1
                except StreamOverflow as overflow:
                    self.told["overflown"] += overflow.lost

    def _read_events(self) -> None:
        with self.client.events() as events:
            while True:
                self.told[type(events.receive(timeout=None)).__name__] += 1


def gain(samples: list[Held], memory: list[float]) -> float:
    """Return what a line fitted to memory gains over all samples, MiB."""
    times = np.array([sample.at for sample in samples])
    return float(np.polyfit(times - times[0], memory, 1)[0] * (times[-1] - times[0]))


def verdict(name: str, samples: list[Held], warm_at: float) -> bool:
    """Print whether a process holds what it held after warming up."""
    warm = [sample for sample in samples if sample.at >= warm_at]
    third = max(1, len(warm) // 3)
    resident = gain(warm, [sample.rss_mib for sample in warm])
    held = [sample.allocated_mib for sample in warm if sample.allocated_mib is not None]
    grows = gain(warm, held) if held else resident
    allocated = f"{grows:+.2f} MiB allocated (now {held[-1]:.1f}), " if held else ""
    # The least: what leaks is never less, and what a sample happens to catch comes and goes.
    more = {
        what: min(getattr(s, what) for s in warm[-third:]) - min(getattr(s, what) for s in warm[:third])
        for what in ("threads", "descriptors")
    }
    good = grows <= GROWTH_MIB and max(more.values()) <= 0
    print(
        f"{name:12} {'flat' if good else 'GROWS':6} {resident:+.2f} MiB resident, {allocated}"
        f"threads {more['threads']:+d}, descriptors {more['descriptors']:+d}"
    )
    return good


def main() -> int:
    """Soak, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--sample", type=float, default=5.0, help="seconds between samples (default: 5)")
    parser.add_argument("--rows", type=int, default=12, help="rows of the table that is printed (default: 12)")
    parser.add_argument("--pause", type=float, default=5.0, help="seconds between rounds (default: 5)")
    arguments = parser.parse_args()

    pairs: list[Pair] = []
    for shm in (False, True):
        for restarted in (False, True):
            server = Server(shm=shm)
            name = f"{'shm' if shm else 'zmq'} {'restarted' if restarted else 'lasting'}"
            pairs.append(Pair(name, server, server.client(), restarted))
    lasting = {pair.name: pair.server.pid for pair in pairs if not pair.restarted}
    watched = {"client": os.getpid(), **lasting}
    samples: dict[str, list[Held]] = {name: [] for name in watched}

    stop = threading.Event()
    workers = [threading.Thread(target=pair.rounds, args=[stop, arguments.pause], daemon=True) for pair in pairs]
    began, processor = time.monotonic(), time.process_time()
    for worker in workers:
        worker.start()
    every = arguments.minutes * 60 / arguments.rows
    shown = 0
    print(f"{'minute':>6}  " + "  ".join(f"{name + ' MiB/threads/fds':>28}" for name in watched), flush=True)
    while (now := time.monotonic() - began) < arguments.minutes * 60 and not any(pair.wrong for pair in pairs):
        row = {name: held_by(pid, now) for name, pid in watched.items()}
        for name, held in row.items():
            samples[name].append(held)
        if now >= shown * every:
            cells = (f"{held.rss_mib:.1f} / {held.threads} / {held.descriptors}" for held in row.values())
            print(f"{now / 60:6.1f}  " + "  ".join(f"{cell:>28}" for cell in cells), flush=True)
            shown += 1
        time.sleep(arguments.sample)
    stop.set()
    for worker in workers:
        worker.join(120)
    took = time.monotonic() - began
    for pair in pairs:
        pair.server.end(kill=False)
    print(f"\n{took / 60:.1f} minutes; this process used {time.process_time() - processor:.0f} s of a processor\n")
    for pair in pairs:
        print(f"{pair.name}: {pair.server.starts} starts; {', '.join(f'{n} {w}' for w, n in pair.told.items())}")
        if pair.restarted:
            most = pair.server.most
            print(f"  a server held at most {most.rss_mib:.0f} MiB, {most.threads} threads, {most.descriptors} fds")
        for wrong in pair.wrong:
            print(f"  WRONG: {wrong}")
    print()
    if any(pair.wrong for pair in pairs):
        return 1
    good = [verdict(name, samples[name], arguments.minutes * 60 * WARM_UP) for name in watched]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
