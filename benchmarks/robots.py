"""Robots to measure with, and what a real server answers about them."""

from __future__ import annotations

import functools
import importlib.util
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.canned import Requester
from urlab_client.protocol.base import Request
from urlab_client.protocol.codec import decode_reply, encode_request, op_of
from urlab_client.protocol.messages.runtime import SetMode
from urlab_client.protocol.messages.session import Forward, Hello, HelloOk, Meta, Step
from urlab_client.server import SimulatedServer

__all__ = ["DIALECT", "dialect", "humanoid", "recorded", "recorded_of", "robot_mjcf"]

DIALECT = "URLAB_BENCHMARK_DIALECT"
"""Environment variable that names the dialect of all servers, for child processes, too."""

_SENSORS = """
    <gyro name="imu_gyro" site="imu"/>
    <accelerometer name="imu_acc" site="imu"/>
    <framequat name="imu_quat" objtype="site" objname="imu"/>
"""


def robot_mjcf(joints: int, *, terrain: int = 0, standing: bool = False) -> str:
    """Return a robot with a free base, so many hinges in limbs of six, a motor each, and an inertial unit.

    Args:
        joints: Hinges.
        terrain: Side of a height field that only makes the model large, samples.
        standing: Give it ground to touch; otherwise it falls freely, and physics has least to do.
    """
    limbs: list[str] = []
    for start in range(0, joints, 6):
        chain = ""
        for i in reversed(range(start, min(start + 6, joints))):
            chain = (
                f'<body name="link{i}" pos="0 0 -0.08"><joint name="joint{i}" axis="{i % 2} {(i + 1) % 2} 0"'
                f' range="-60 60"/><geom type="capsule" size="0.02 0.03" contype="{int(standing)}" conaffinity="0"/>'
                f"{chain}</body>"
            )
        limbs.append(chain)
    motors = "".join(f'<motor name="motor{i}" joint="joint{i}" gear="5"/>' for i in range(joints))
    ground = '<geom type="plane" size="5 5 1"/>' if standing else ""
    asset = f'<hfield name="terrain" nrow="{terrain}" ncol="{terrain}" size="5 5 1 1"/>' if terrain else ""
    return f"""<mujoco model="robot">
    <default><joint damping="0.5" armature="0.01"/></default>
    <asset>{asset}</asset>
    <worldbody>{ground}<body name="torso" pos="0 0 {0.5 if standing else 1}"><freejoint name="root"/><site name="imu"/>
    <geom type="box" size="0.1 0.1 0.2"/>{"".join(limbs)}</body></worldbody>
    <actuator>{motors}</actuator>
    <sensor>{_SENSORS}</sensor>
    </mujoco>"""


def dialect() -> str:
    """Return the dialect of all servers."""
    return os.environ.get(DIALECT, "alpha")


@functools.cache
def recorded(
    joints: int, count: int = 1, *, mode: str = "direct", terrain: int = 0, spoken: str = ""
) -> Mapping[str, bytes]:
    """Return what the simulated server answers to `hello`, `meta`, `set_mode`, `forward` and `step`, by op.

    Args:
        joints: Hinges of each robot.
        count: Robots.
        mode: Step mode that the server is left in.
        terrain: See `robot_mjcf`.
        spoken: Dialect of the answers, where it is not that of all servers.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(robot_mjcf(joints, terrain=terrain))
        return recorded_of(path, count, mode=mode, spoken=spoken)


def recorded_of(path: Path, count: int = 1, *, mode: str = "direct", spoken: str = "") -> dict[str, bytes]:
    """Return what `recorded` does of the robots in an MJCF file."""
    answers: dict[str, bytes] = {}
    # Older packages know one dialect only, and no option.
    spoken = spoken or dialect()
    options: dict[str, Any] = {} if spoken == "alpha" else {"dialect": spoken}
    with SimulatedServer(*[path] * count, play=True, **options) as server, Requester(server.step_port) as floor:
        answers["hello"] = floor.ask(encode_request(Hello(), ""))
        hello = decode_reply(op_of(Hello), HelloOk, answers["hello"])
        others: list[Request[Any]] = [Meta(), SetMode(mode=mode), Forward(), Step()]
        for request in others:
            answers[op_of(request).name] = floor.ask(encode_request(request, hello.session_id))
        if options:
            answers |= _of_owned_robots(floor, hello)
    return answers


def _of_owned_robots(floor: Requester, hello: HelloOk) -> dict[str, bytes]:
    """Return what else a server answers to whoever drives its robots, and a handshake that names no other ports."""
    from urlab_client.protocol.messages.runtime import SetPaused  # noqa: PLC0415
    from urlab_client.protocol.registry import OPS  # noqa: PLC0415  # older packages lack this op

    claim_control: Any = OPS["claim_control"].request
    claim: Request[Any] = claim_control(articulation=hello.articulations[0].prefix)
    plain = msgspec.msgpack.decode(floor.ask(encode_request(Hello(), "")))
    for elsewhere in ("instance", "shm_rpc"):
        plain.pop(elsewhere, None)
    return {
        "claim_control": floor.ask(encode_request(claim, plain["session_id"])),
        "set_paused": floor.ask(encode_request(SetPaused(paused=True), plain["session_id"])),
        "hello": msgspec.msgpack.encode(plain),
    }


def humanoid() -> Path:
    """Return Gymnasium's humanoid: 17 motors, 12 contacts when it lies, integrated by Runge-Kutta's fourth order."""
    spec = importlib.util.find_spec("gymnasium")
    if spec is None or spec.origin is None:
        raise SystemExit("The humanoid is Gymnasium's: pip install -e '.[gym]'.")
    return Path(spec.origin).parent / "envs" / "mujoco" / "assets" / "humanoid.xml"
