"""Servers for the checks of `urlab_client.conformance`: two robots in a saved level, with or without play."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any

from urlab_client.conformance import Bench, Wire
from urlab_client.conformance.bench import write_robot
from urlab_client.server import SimulatedServer

BOT = """
<mujoco model="bot">
  <compiler angle="radian"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom name="ball" type="sphere" size="0.1" mass="1"/>
      <camera name="cam" pos="0 -1 0"/>
      <body name="arm" pos="0 0 0.2">
        <joint name="j" axis="0 1 0"/>
        <geom name="link" type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="s" joint="j"/></sensor>
  <keyframe><key name="home" time="1.5" qpos="0 0 1 1 0 0 0 0.5" ctrl="0.3"/></keyframe>
</mujoco>
"""


@contextmanager
def server(folder: Path, dialect: Any, *, shm: bool) -> Iterator[SimulatedServer]:
    """Serve an editor that may import the two models of a folder."""
    (folder / "bot.xml").write_text(BOT)
    write_robot(folder)
    options: dict[str, Any] = {"shm_dir": folder} if shm else {}
    made = SimulatedServer(dialect=dialect, model_roots=[folder], camera_size=(64, 48), **options)
    with made as served:
        yield served


@asynccontextmanager
async def bench(
    served: SimulatedServer, folder: Path, *, shm: bool = False, port: int = 0, state_port: int = 0
) -> AsyncIterator[Bench]:
    """Connect to a server, or to a relay in front of it at another port."""
    wire = Wire(f"tcp://127.0.0.1:{port or served.step_port}", 0, None, shm=shm, timeout=30)
    made = Bench(wire, import_file=str(folder / "urlab_conformance_robot.xml"))
    made.state_port = state_port or served.state_port
    try:
        await made.open()
        yield made
    finally:
        await wire.aclose()


async def furnish(bench: Bench, folder: Path, *, play: bool = True) -> None:
    """Open a saved level with two robots, one of them without an actor id."""
    await bench.ask("create_level", name="lab")
    await bench.ask("ensure_manager")
    blueprint = (await bench.ask("import_xml", path=str(folder / "bot.xml")))["blueprint_class_path"]
    await bench.ask("spawn_actor", blueprint=blueprint, actor_id="arm a")
    await bench.ask("spawn_actor", blueprint=blueprint, actor_id="", location=[0.0, 2.0, 0.0])
    await bench.ask("save_level")
    if play:
        started = await bench.ask("begin_pie", timeout_s=60)
        assert started["state"] == "ready", started
    await bench.greet()
