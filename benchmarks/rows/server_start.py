"""`urlab serve` with a robot of many large meshes, against a program that only loads it."""

from __future__ import annotations

import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.harness import Figure, Pair, Row
from benchmarks.robots import dialect

__all__ = ["ROWS"]

_LINKS = 30
_RINGS = 72
"""Rings of a mesh, of twice as many corners each: some 20,000 triangles, a megabyte."""

_LOAD = """
import sys
import mujoco
model = mujoco.MjModel.from_xml_path(sys.argv[1])
mujoco.mj_forward(model, mujoco.MjData(model))
print("ready", flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def _robot() -> Iterator[Path]:
    """A chain of links, each with a mesh of its own, 30 MB together."""
    with tempfile.TemporaryDirectory() as folder:
        chain = ""
        for link in reversed(range(_LINKS)):
            _write_mesh(Path(folder, f"link{link}.stl"), link)
            chain = (
                f'<body name="link{link}" pos="0 0 0.2"><joint name="joint{link}" axis="0 1 0"/>'
                f'<geom type="mesh" mesh="link{link}"/>{chain}</body>'
            )
        meshes = "".join(f'<mesh name="link{link}" file="link{link}.stl"/>' for link in range(_LINKS))
        robot = Path(folder, "robot.xml")
        robot.write_text(
            f'<mujoco model="robot"><asset>{meshes}</asset><worldbody><body name="base" pos="0 0 1"><freejoint/>'
            f'<geom size="0.1"/>{chain}</body></worldbody></mujoco>'
        )
        yield robot


def _write_mesh(path: Path, link: int) -> None:
    """Write a lump as STL, where each triangle has its own three corners."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, _RINGS), np.linspace(0, 2 * np.pi, 2 * _RINGS), indexing="ij")
    radius = 0.1 * (1 + 0.2 * np.sin((3 + link % 5) * polar) * np.sin(5 * around))
    across = np.sin(polar)
    points = np.stack([across * np.cos(around), across * np.sin(around), np.cos(polar)], -1) * radius[..., None]
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    corners = np.concatenate([np.stack([a, b, c], -2)[1:].reshape(-1, 3, 3), np.stack([a, c, d], -2).reshape(-1, 3, 3)])
    facets = np.zeros(len(corners), np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")]))
    facets["corners"] = corners
    path.write_bytes(bytes(80) + len(facets).to_bytes(4, "little") + facets.tobytes())


class _Started:
    """What starts a program until it says that it is ready."""

    def __init__(self, command: Sequence[str]) -> None:
        self._command = [sys.executable, *command]
        self.peaks: list[int] = []
        self.processor_s: list[float] = []

    def burst(self, count: int) -> list[float]:
        """Start it so many times; return the seconds of each."""
        return [self._start() for _ in range(count)]

    def _start(self) -> float:
        started = time.perf_counter()
        with subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None  # noqa: S101
            assert process.stdin is not None  # noqa: S101
            process.stdout.readline()
            took = time.perf_counter() - started
            with contextlib.suppress(OSError):  # another system
                self._look(process.pid)
            process.stdin.close()
        return took

    def _look(self, process: int) -> None:
        status = dict(line.split(":", 1) for line in Path(f"/proc/{process}/status").read_text().splitlines())
        self.peaks.append(int(status["VmHWM"].split()[0]))
        of_process = (
            Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        )  # with threads that have ended
        self.processor_s.append((int(of_process[11]) + int(of_process[12])) / os.sysconf("SC_CLK_TCK"))


@contextlib.contextmanager
def _starts() -> Iterator[Pair]:
    with _robot() as robot:
        ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
        serve = ["-m", "urlab_client", "serve", str(robot), "--play", "--json", "--until-eof"]
        ours = _Started([*serve, f"--dialect={dialect()}", *ports])
        floor = _Started(["-c", _LOAD, str(robot)])
        yield Pair(ours=ours.burst, floor=floor.burst, figures=lambda: _figures(ours, floor))


def _figures(ours: _Started, floor: _Started) -> list[Figure]:
    if not ours.peaks:
        return []
    processor = statistics.median(ours.processor_s) / statistics.median(floor.processor_s)
    memory = statistics.median(ours.peaks) / statistics.median(floor.peaks)
    return [
        Figure(name="processor time / that of loading it", value=processor, at_most=2.0),
        Figure(name="peak memory / that of loading it", value=memory, at_most=1.5),
    ]


ROWS = (
    Row(
        name="server-start-meshes",
        what="start of urlab serve, a robot of 30 MB of meshes, in play",
        floor="a program that loads it and calls mj_forward",
        reach=2.0,
        prepare=_starts,
        count=1,
    ),
)
