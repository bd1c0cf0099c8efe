"""Make the animation of the home page and the README: the bundled quadruped trots on the simulated server."""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from urlab_client import URLabClient
from urlab_client.cli.demo import Trot
from urlab_client.server import SimulatedServer

TARGET = Path(__file__).resolve().parent.parent / "docs" / "images" / "trot.webp"
SIZE = (640, 320)
FRAMES_PER_S = 20
START_S, LENGTH_S = 1.0, 2.0
"""From full stride on, and whole strides, so that the legs go on where the animation starts again."""


def main() -> int:
    pictures: list[Image.Image] = []
    with (
        SimulatedServer("quadruped", play=True, render_quality="high") as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        client.reset("home")
        robot = client.articulations["quadruped"]
        trot = Trot(robot)
        end = START_S + LENGTH_S
        while client.sim_time < end - 1e-9:
            due = START_S + len(pictures) / FRAMES_PER_S
            while client.sim_time < min(due, end) - 1e-9:
                trot.act(client.sim_time)
                client.step()
            if client.sim_time < end - 1e-9:
                x, y, _ = robot.root_pos_w
                client.viewport.set_camera((x + 1.15, y - 1.05, 0.72), rotation_euler=(0.0, -19.0, -137.5), fov=46.0)
                pictures.append(Image.fromarray(server.snapshot(SIZE)).convert("RGB"))
    unfinished = TARGET.with_name(f".{TARGET.name}")
    pictures[0].save(
        unfinished,
        format="webp",
        save_all=True,
        append_images=pictures[1:],
        duration=round(1000 / FRAMES_PER_S),
        loop=0,
        quality=60,
        method=4,
    )
    unfinished.replace(TARGET)
    print(f"{TARGET}: {len(pictures)} pictures, {TARGET.stat().st_size / 1024:.0f} KiB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
