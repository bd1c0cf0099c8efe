"""How well live mode keeps pace: simulated against wall time, processor share, and what a stall leaves behind.

    python tools/check_pacing.py [--seconds 10] [--model MODEL]

The server runs in a child process, with Gymnasium's humanoid at 2 ms by default, and is stopped for half a second in
the middle: afterwards simulation time is to go on at the wall's rate, and not to catch up. Prints figures only.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import gymnasium
import msgspec
import mujoco

from urlab_client import URLabClient

HUMANOID = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "humanoid.xml"
STALL_S = 0.5


def processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def pace(client: URLabClient, pid: int, seconds: float) -> tuple[float, float]:
    """Return simulated seconds and processor seconds per wall second."""
    client.runtime.set_paused(False)
    client.step()
    wall, simulated, processor = time.perf_counter(), client.sim_time, processor_seconds(pid)
    threading.Event().wait(seconds)
    client.step()
    took = time.perf_counter() - wall
    return (client.sim_time - simulated) / took, (processor_seconds(pid) - processor) / took


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--model", default=str(HUMANOID))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure(without_cameras(arguments.model, Path(folder)), arguments.seconds)


def without_cameras(model: str, folder: Path) -> str:
    """Return a copy of a model without cameras: a live client receives their pictures, which the processor may draw."""
    spec = mujoco.MjSpec.from_file(model)
    for camera in list(spec.cameras):
        spec.delete(camera)
    spec.compile()
    path = folder / Path(model).name
    path.write_text(spec.to_xml())
    return str(path)


def measure(model: str, seconds: float) -> None:
    ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    command = [
        sys.executable,
        "-m",
        "urlab_client",
        "serve",
        model,
        "--play",
        "--json",
        "--until-eof",
        *ports,
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as server:  # noqa: S603
        if server.stdin is None or server.stdout is None:
            raise TypeError("the server's input and output must be pipes")
        ready = msgspec.json.decode(server.stdout.readline())
        with URLabClient(ready["address"], step_port=ready["step_port"], state_port=ready["state_port"]) as client:
            client.discover()
            rate, share = pace(client, server.pid, seconds)
            print(f"undisturbed:   {rate:.4f} of real time over {seconds:g} s, {share:.1%} of a core")
            client.runtime.set_sim_speed(50.0)
            rate, _ = pace(client, server.pid, seconds / 2)
            print(f"at 50 %:       {rate:.4f}")
            client.runtime.set_sim_speed(100.0)
            server.send_signal(signal.SIGSTOP)
            threading.Event().wait(STALL_S)
            server.send_signal(signal.SIGCONT)
            rate, share = pace(client, server.pid, seconds)
            print(f"after a stall: {rate:.4f} over {seconds:g} s, {share:.1%} of a core")
        server.stdin.close()


if __name__ == "__main__":
    main()
