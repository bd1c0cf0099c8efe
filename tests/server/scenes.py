"""Models for the tests of the physics engine, compiled as the server compiles them."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium

from urlab_client.server.assets.actors import Actor, ActorKind
from urlab_client.server.assets.blueprint import Blueprint
from urlab_client.server.assets.content import ContentRoot
from urlab_client.server.compile.scene import CompiledScene, compile_scene
from urlab_client.server.physics.engine import Engine

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"

BOT = """
<mujoco model="bot">
  <compiler angle="radian"/>
  <option timestep="0.005" gravity="0 0 -1" integrator="RK4"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -5"/>
    <body name="base" pos="0 0 1">
      <freejoint name="root"/>
      <geom type="sphere" size="0.1" mass="1"/>
      <camera name="cam"/>
      <site name="tip"/>
      <body name="arm" pos="0 0 0.2">
        <joint name="j" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="0.5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j" ctrlrange="-1 1"/></actuator>
  <sensor><jointpos name="s" joint="j"/></sensor>
  <keyframe><key name="home" time="1.5" qpos="0 0 1 1 0 0 0 0.5" ctrl="0.3"/></keyframe>
</mujoco>
"""

BALL = """
<mujoco model="ball">
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <body name="ball" pos="0 0 1">
      <freejoint name="root"/>
      <geom type="sphere" size="0.1" mass="1"/>
    </body>
  </worldbody>
</mujoco>
"""


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="urlab-scenes-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@cache
def _content() -> ContentRoot:
    return ContentRoot(_folder() / "content")


@cache
def blueprint(source: str | Path) -> Blueprint:
    """Import an MJCF file, or the text of one."""
    if isinstance(source, str):
        path = _folder() / f"robot_{len([*_folder().iterdir()])}.xml"
        path.write_text(source)
        source = path
    return _content().import_xml(str(source), trusted=True)[0]


def make_scene(*others: Actor, **robots: str | Path) -> CompiledScene:
    """Compile robots by articulation key, 2 m apart along x, and other actors."""
    actors = [
        Actor(
            name=key, label=key, kind=ActorKind.ARTICULATION, blueprint=blueprint(source), location=(2.0 * at, 0.0, 0.0)
        )
        for at, (key, source) in enumerate(robots.items())
    ]
    return compile_scene([*actors, *others])


def hasty(step_timeout_s: float) -> Callable[..., Engine]:
    """Return what makes engines that give up on a step so soon, and wait for physics as long as any other.

    The argument `step_timeout_s` bounds every wait for the lock, which a busy machine may well exceed.
    """

    def make(*args: Any, **options: Any) -> Engine:
        engine = Engine(*args, **options)
        engine._step_timeout_s = step_timeout_s
        return engine

    return make
