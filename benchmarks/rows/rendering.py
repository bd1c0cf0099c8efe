"""A robot drawn without a display, against the rasteriser by itself."""

from __future__ import annotations

import contextlib
import importlib.util
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import mujoco

from benchmarks import bare_renderer
from benchmarks.harness import Figure, Pair, Row
from benchmarks.robots import dialect, humanoid
from urlab_client import URLabClient
from urlab_client.simulation.opengl import Backend, need_backend

__all__ = ["ROWS"]

_CAMERA = "track"  # the humanoid's own, which follows it
_PICTURES_PER_S = 150


@contextlib.contextmanager
def _bare(backend: Backend, model: mujoco.MjModel, camera: str, size: tuple[int, int]) -> Iterator[_Bare]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.mjb")
        mujoco.mj_saveModel(model, str(path), None)
        command = [sys.executable, bare_renderer.__file__, backend.name, str(path), camera, *map(str, size)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
            assert process.stdin is not None  # noqa: S101
            try:
                yield _Bare(process)
            finally:
                process.stdin.close()


class _Bare:
    """The script, asked for pictures.

    Attributes:
        processor_s: Processor time of a picture, one mean for each burst, all threads of the rasteriser counted.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self.processor_s: list[float] = []

    def burst(self, count: int) -> list[float]:
        """Let it draw so many pictures and return the seconds of each."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None and stdout is not None  # noqa: S101, PT018
        stdin.write(b"%d\n" % count)
        stdin.flush()
        times, busy = msgspec.json.decode(stdout.readline(), type=tuple[list[float], float])
        self.processor_s.append(busy / count)
        return times


@contextlib.contextmanager
def _pictures() -> Iterator[Pair]:
    backend = need_backend()
    address = f"sim://{humanoid()}?render-quality=fast&dialect={dialect()}"
    with URLabClient(address, step_mode="direct") as client:
        client.discover()
        key, robot = next(iter(client.articulations.items()))
        view = robot.cameras[_CAMERA]
        model = client.model
        assert model is not None  # noqa: S101
        wanted = {f"{key}/{_CAMERA}": "sync"}
        taken: list[float] = []

        def ours(count: int) -> list[float]:
            client.reset()  # as long as it stands, as in the floor's picture
            times: list[float] = []
            for _ in range(count):
                started = time.perf_counter()
                client.step(include_cameras=wanted)
                times.append(time.perf_counter() - started)
            taken.extend(times)
            return times

        with _bare(backend, model, f"{key}_{_CAMERA}", view.resolution) as bare:
            yield Pair(
                ours=ours,
                floor=bare.burst,
                figures=lambda: [
                    Figure(
                        name="ms of a step with its picture",
                        value=1e3 * statistics.median(taken),
                        at_most=1e3 / _PICTURES_PER_S,
                    ),
                    Figure(
                        name="ms of processor time of a picture, the rasteriser by itself",
                        value=1e3 * statistics.median(bare.processor_s),
                    ),
                ],
            )


def _rows() -> tuple[Row, ...]:
    if importlib.util.find_spec("gymnasium") is None:
        return ()
    return (
        Row(
            name="render-humanoid",
            what="client.step() with a picture of 640x480 of Gymnasium's humanoid, drawn at fast by the server",
            floor="mjr_render and mjr_readPixels of the same picture, by themselves",
            reach=1.25,
            prepare=_pictures,
            count=20,
        ),
    )


ROWS = _rows()
