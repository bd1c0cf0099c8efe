"""What a lossless recording costs a program that steps and looks at two cameras."""

from __future__ import annotations

import contextlib
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.harness import Figure, Pair, Row
from benchmarks.robots import dialect
from urlab_client import URLabClient

__all__ = ["ROWS"]

_CAMERAS = 2
_SUBSTEPS = 10  # 20 ms for each pair of pictures


def _mjcf() -> str:
    """Return an arm that swings before two cameras of 640 x 480."""
    cameras = "".join(
        f'<camera name="eye{i}" pos="{i} -2 1" xyaxes="1 0 0 0 0.4 1" resolution="640 480"/>' for i in range(_CAMERAS)
    )
    return f"""<mujoco model="robot"><worldbody><light pos="0 0 3"/><geom type="plane" size="2 2 1"/>{cameras}
    <body pos="0 0 1"><joint name="shoulder" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.05"/>
    <body pos="0.4 0 0"><joint name="elbow" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.04"/>
    </body></body></worldbody><actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""


@contextlib.contextmanager
def _client(address: str) -> Iterator[URLabClient]:
    with URLabClient(address, step_mode="direct") as client:
        client.discover()
        _step(client)
        yield client


def _step(client: URLabClient) -> None:
    # Drawn with the step, as a recording wants them: else the server would draw fewer pictures without one.
    cameras = [f"{key}/{name}" for key, robot in client.articulations.items() for name in robot.cameras]
    client.step(_SUBSTEPS, include_cameras=dict.fromkeys(cameras, "sync"))


@contextlib.contextmanager
def _recording() -> Iterator[Pair]:
    from urlab_client.integrations.record import record  # noqa: PLC0415  # an extra

    processor: dict[str, list[float]] = {"with": [], "without": []}
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder, "robot.xml")
        robot.write_text(_mjcf())
        with _client(f"sim://{robot}?dialect={dialect()}") as client:

            def stepping(count: int, into: list[float]) -> list[float]:
                client.reset()
                started, busy = time.perf_counter(), time.process_time()
                for _ in range(count):
                    _step(client)
                took = time.perf_counter() - started
                into.append((time.process_time() - busy) / count)
                return [took / count]

            recorded = Path(folder, "run.mcap")

            def ours(count: int) -> list[float]:
                with record(client, recorded, cameras="all") as recorder:
                    taken = stepping(count, processor["with"])
                lost = recorder.stats.dropped_states + recorder.stats.dropped_frames
                assert not lost, recorder.stats  # noqa: S101
                recorded.unlink()
                return taken

            def floor(count: int) -> list[float]:
                return stepping(count, processor["without"])

            def figures() -> list[Figure]:
                added = statistics.median(processor["with"]) - statistics.median(processor["without"])
                return [Figure(name="processor time that recording adds to a step, ms", value=1e3 * added)]

            yield Pair(ours=ours, floor=floor, figures=figures)


def _rows() -> tuple[Row, ...]:
    if any(importlib.util.find_spec(name) is None for name in ("mcap", "PIL")):
        return ()
    return (
        Row(
            name="record-2-cameras",
            what="direct steps with two cameras of 640x480, recorded losslessly as MCAP",
            floor="the same, not recorded",
            reach=0.7,
            kind="rate",
            prepare=_recording,
            count=100,
        ),
    )


ROWS = _rows()
