"""Drive a simulated server whose interpreter has another MuJoCo: direct, live and puppet mode.

Also compile here what it writes there of a robot with every kind of actuator, in each dialect, as it stands.

Run: python tools/drive_other_release.py SERVER_PYTHON

The client is this interpreter's. Exit code 1 says that a mode does not work.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from urlab_client import URLabClient, URLabError, URLabVersionMismatch
from urlab_client.protocol.messages.session import Hello

PORTS = ("step", "state", "ctrl", "info", "camera")
MODES = ("direct", "live", "puppet")
DIALECTS = ("alpha", "beta")
STEPS = 20

SERVOS = """
<mujoco model="servos">
  <default>
    <default class="fast"><position kp="5"/></default>
    <default class="slow"><velocity kv="3"/></default>
  </default>
  <worldbody><body name="arm"><joint name="j"/><geom size="0.1"/></body></worldbody>
  <actuator>
    <motor joint="j"/>
    <position joint="j" class="fast"/>
    <position joint="j" kp="3" timeconst="0.1"/>
    <velocity joint="j" kv="2"/>
    <velocity joint="j" class="slow"/>
    <intvelocity joint="j" kp="2" actrange="-1 1"/>
    <damper joint="j" kv="2" ctrlrange="0 1"/>
    <cylinder joint="j" area="2"/>
    <muscle joint="j" lengthrange="0 1"/>
    <adhesion body="arm" ctrlrange="0 1"/>
    <dcmotor joint="j" motorconst="1 1" resistance="1"/>
    <general joint="j" gainprm="4" biastype="affine" biasprm="0 -4 -1"/>
  </actuator>
</mujoco>"""
"""What the oldest release has of actuators."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Drive a server that has another MuJoCo.")
    parser.add_argument("server", metavar="SERVER_PYTHON")
    arguments = parser.parse_args()
    with serving(arguments.server, "arm", "ball") as options:
        problems = [problem for mode in MODES if (problem := drive(mode, options))]
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder, "servos.xml")
        robot.write_text(SERVOS)
        for dialect in DIALECTS:
            with serving(arguments.server, str(robot), f"--dialect={dialect}") as options:
                problems += [problem] if (problem := compile_here(dialect, robot, options)) else []
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


@contextmanager
def serving(python: str, *arguments: str) -> Generator[dict[str, Any]]:
    """Start a server; yields how to connect to it."""
    command = [python, "-m", "urlab_client", "serve", *arguments, "--json", "--until-eof", "--play"]
    command += [f"--{name}-port=0" for name in PORTS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:  # noqa: S603
        assert server.stdin is not None and server.stdout is not None  # noqa: PT018, S101
        ready = json.loads(server.stdout.readline())
        yield {"address": ready["address"], "step_port": ready["step_port"], "state_port": ready["state_port"]}
        server.stdin.close()


def compile_here(dialect: str, robot: Path, options: dict[str, Any]) -> str:
    """Compile a server's documents as any client would; return what went wrong."""
    with URLabClient(**options) as client:
        hello = client.call(Hello(include_assets=True))
    try:
        model = mujoco.MjModel.from_xml_string(hello.mjcf_compiled or "", dict(hello.vfs_assets or {}))
    except ValueError as error:
        return f"{dialect}: MuJoCo {mujoco.mj_versionString()} rejects what {hello.mujoco_version} wrote: {error}"
    original = mujoco.MjModel.from_xml_path(str(robot))
    print(f"{dialect}: {model.nu} actuators of {hello.mujoco_version} compiled by {mujoco.mj_versionString()}")
    for name in ("actuator_dyntype", "actuator_gaintype", "actuator_gainprm", "actuator_biastype", "actuator_biasprm"):
        ours, theirs = getattr(model, name), getattr(original, name)
        if ours.shape != theirs.shape or not np.allclose(ours, theirs):
            return f"{dialect}: {name} is {ours}, not {theirs}"
    return ""


def drive(mode: str, options: dict[str, Any]) -> str:
    """Step a robot in one mode; return what went wrong."""
    try:
        with URLabClient(**options) as client:
            client.discover()
        expected = mujoco.mj_versionString()
    except URLabVersionMismatch as mismatch:
        expected = mismatch.server_version
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with URLabClient(**options, mujoco_version_check=False, step_mode=mode) as client:
                client.discover()
                client.reset()
                arm = client.articulations["arm"]
                if mode == "live":
                    client.runtime.set_paused(paused=False)
                arm.set_ctrl(dict.fromkeys([*arm.actuators][:2], 0.1))
                before = client.sim_time
                for _ in range(STEPS):
                    client.step(5)
                moved = abs(arm.qpos_array).max()
                print(
                    f"{mode}: client {mujoco.mj_versionString()}, server {client.mujoco_version}, moved by {moved:.3f}"
                )
                if client.sim_time <= before or not moved or client.mujoco_version != expected:
                    return f"{mode}: nothing moved, from {before} s to {client.sim_time} s"
        except (URLabError, ValueError) as error:
            return f"{mode}: {type(error).__name__}: {error}"
    return ""


if __name__ == "__main__":
    sys.exit(main())
