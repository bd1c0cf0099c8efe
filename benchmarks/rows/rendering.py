"""Robots drawn without a display, for a client and for environments, against the rasteriser by itself."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import mujoco

from benchmarks import bare_renderer
from benchmarks.harness import Figure, Pair, Row, each
from benchmarks.machine import processor_s
from benchmarks.robots import dialect, humanoid
from urlab_client import URLabClient
from urlab_client.server.assets.bundled_robots import bundled_models
from urlab_client.simulation.opengl import Backend, need_backend

__all__ = ["ROWS"]

_CAMERA = "track"  # the humanoid's own, which follows it
_SIZES = ((64, 64), (128, 128), (640, 480))
_CAMERAS = (1, 4, 16)
_COPIES = 4
_SUBSTEPS = 10
_LEAST = {"batch": 0.4, "env": 0.2}  # small pictures are drawn faster than a server answers


@contextlib.contextmanager
def _bare(backend: Backend, model: mujoco.MjModel, cameras: Sequence[str], size: tuple[int, int]) -> Iterator[_Bare]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.mjb")
        mujoco.mj_saveModel(model, str(path), None)
        names = ",".join(cameras)
        command = [sys.executable, bare_renderer.__file__, backend.name, str(path), names, *map(str, size)]
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

        with _bare(backend, model, [f"{key}_{_CAMERA}"], view.resolution) as bare:
            yield Pair(
                ours=ours,
                floor=bare.burst,
                figures=lambda: [
                    Figure(
                        name="ms of a step with its picture",
                        value=1e3 * statistics.median(taken),
                    ),
                    Figure(
                        name="ms of processor time of a picture, the rasteriser by itself",
                        value=1e3 * statistics.median(bare.processor_s),
                    ),
                ],
            )


@contextlib.contextmanager
def _scene(width: int, height: int, cameras: Sequence[str]) -> Iterator[str]:
    """Lend the address of the bundled arm with cameras of that size around it."""
    turns = [2.0 * math.pi * i / len(cameras) for i in range(len(cameras))]
    added = "".join(
        f'<camera name="{name}" pos="{1.2 * math.cos(turn):.3f} {1.2 * math.sin(turn):.3f} 0.9" mode="targetbody" '
        'target="forearm"/>'
        for name, turn in zip(cameras, turns, strict=True)
    )
    arm = bundled_models()["arm"].read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "arm.xml")
        path.write_text(arm.replace("<worldbody>", f"<worldbody>{added}", 1), encoding="utf-8")
        yield f"sim://{path}?render-quality=fast&camera-size={width}x{height}&dialect={dialect()}"


def _batch(address: str, **options: Any) -> tuple[Any, mujoco.MjModel]:
    from urlab_client.integrations.gym import URLabBatchEnv  # noqa: PLC0415  # an extra

    batch = URLabBatchEnv(address, _COPIES, **options)
    return batch, batch.model


def _single(address: str, **options: Any) -> tuple[Any, mujoco.MjModel]:
    from urlab_client.integrations.gym import URLabEnv  # noqa: PLC0415  # an extra

    environment = URLabEnv.connect(address, **options)
    assert environment.client.model is not None  # noqa: S101
    return environment, environment.client.model


@contextlib.contextmanager
def _observed(
    make: Callable[..., tuple[Any, mujoco.MjModel]], copies: int, size: tuple[int, int], cameras: int
) -> Iterator[Pair]:
    """Steps of an environment that observes pictures, counted by picture."""
    backend = need_backend()
    names = [f"eye{i}" for i in range(cameras)]
    with _scene(*size, names) as address:
        options = {"cameras": [f"arm/{name}" for name in names], "space_mode": "dict", "n_substeps": _SUBSTEPS}
        environment, model = make(address, **options)
        with contextlib.closing(environment), _bare(backend, model, [f"arm_{name}" for name in names], size) as bare:
            action = environment.action_space.sample()
            environment.reset(seed=0)
            ours = each(lambda: environment.step(action))
            pictures, processor = copies * cameras, list[float]()

            def burst(count: int) -> list[float]:
                busy = processor_s()
                times = [time_s / pictures for time_s in ours(count)]
                processor.append((processor_s() - busy) / (count * pictures))
                return times

            yield Pair(
                ours=burst,
                floor=lambda count: bare.burst(count * pictures),
                figures=lambda: [
                    Figure(
                        name="ms of processor time of a picture, with the server's and the rasteriser's threads",
                        value=1e3 * statistics.median(processor),  # the first burst makes the context
                    ),
                    Figure(name="the floor's", value=1e3 * statistics.median(bare.processor_s)),
                ],
            )


def _picture_rows() -> Iterator[Row]:
    for kind, make, copies in (("batch", _batch, _COPIES), ("env", _single, 1)):
        for width, height in _SIZES:
            for cameras in _CAMERAS:
                yield Row(
                    name=f"pictures-{kind}-{width}x{height}-{cameras}",
                    what=f"pictures per second, {cameras} of {width}x{height} in each step of "
                    f"{f'a batch of {copies}' if copies > 1 else 'URLabEnv'}, {_SUBSTEPS} substeps of the arm",
                    floor="mjr_render and mjr_readPixels of the same pictures, by themselves",
                    reach=_LEAST[kind],
                    kind="rate",
                    prepare=functools.partial(_observed, make, copies, (width, height), cameras),
                    burst_s=0.1,
                )


def _rows() -> tuple[Row, ...]:
    if importlib.util.find_spec("gymnasium") is None:
        return ()
    return (
        Row(
            name="render-humanoid",
            what="client.step() with a picture of 640x480 of Gymnasium's humanoid, drawn at fast by the server",
            floor="mjr_render and mjr_readPixels of the same picture, by themselves",
            reach=2.0,
            prepare=_pictures,
            count=20,
        ),
        *_picture_rows(),
    )


ROWS = _rows()
