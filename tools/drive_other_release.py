"""Drive a simulated server whose interpreter has another MuJoCo: direct, live and puppet mode.

Run: python tools/drive_other_release.py SERVER_PYTHON

The client is this interpreter's. Exit code 1 says that a mode does not work.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import warnings
from typing import Any

import mujoco

from urlab_client import URLabClient, URLabError, URLabVersionMismatch

PORTS = ("step", "state", "ctrl", "info", "camera")
MODES = ("direct", "live", "puppet")
STEPS = 20


def main() -> int:
    parser = argparse.ArgumentParser(description="Drive a server that has another MuJoCo.")
    parser.add_argument("server", metavar="SERVER_PYTHON")
    arguments = parser.parse_args()
    command = [arguments.server, "-m", "urlab_client", "serve", "arm", "ball", "--json", "--until-eof", "--play"]
    command += [f"--{name}-port=0" for name in PORTS]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:  # noqa: S603
        assert server.stdin is not None and server.stdout is not None  # noqa: PT018, S101
        ready = json.loads(server.stdout.readline())
        options = {"address": ready["address"], "step_port": ready["step_port"], "state_port": ready["state_port"]}
        problems = [problem for mode in MODES if (problem := drive(mode, options))]
        server.stdin.close()
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


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
