"""The picture that `urlab demo` draws of the last state."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from urlab_client.cli.picture import draw_state

SCENE = """<mujoco><worldbody>
  <light type="directional" pos="0 0 3" dir="0.2 0.3 -1"/>
  <geom type="plane" size="50 50 1" rgba="0.6 0.6 0.6 1"/>
  <body pos="0 0 0.5"><freejoint/><geom type="box" size="0.2 0.2 0.2" rgba="1 0.5 0 1"/></body>
</worldbody></mujoco>"""


@pytest.mark.opengl
def test_a_robot_that_has_walked_away_keeps_its_shadow(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    pictures = list[np.ndarray]()
    for x in (0.0, 30.0):
        data.qpos[0] = x
        draw_state(model, data, tmp_path / "state.png")
        pictures.append(np.asarray(Image.open(tmp_path / "state.png").convert("RGB"), dtype=np.float64))
    near, far = pictures
    assert (np.abs(near - far).max(axis=2) > 30).mean() < 0.002
