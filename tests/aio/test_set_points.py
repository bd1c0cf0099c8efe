"""What the set-point of an actuator means, and its unit, as the compiled model says."""

from __future__ import annotations

import mujoco
import pytest

from urlab_client.aio.model.layout import set_point_meaning

MODEL = """
<mujoco>
  <worldbody>
    <body><joint name="hinge"/><geom size="0.1"/>
      <body><joint name="slide" type="slide"/><geom size="0.1"/></body>
    </body>
  </worldbody>
  <tendon><fixed name="tendon"><joint joint="hinge" coef="1"/></fixed></tendon>
  <actuator>{}</actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("actuator", "meaning", "unit"),
    [
        ('<position joint="hinge" kp="2"/>', "position", "rad"),
        ('<position joint="slide" kp="2"/>', "position", "m"),
        ('<position joint="hinge" kp="2" gear="3"/>', "position", ""),
        ('<position tendon="tendon" kp="2"/>', "position", ""),
        ('<velocity joint="hinge" kv="2"/>', "velocity", "rad/s"),
        ('<velocity joint="slide" kv="2"/>', "velocity", "m/s"),
        ('<intvelocity joint="hinge" kp="2" actrange="-1 1"/>', "velocity", "rad/s"),
        ('<motor joint="hinge"/>', "force", "N m"),
        ('<motor joint="slide"/>', "force", "N"),
        ('<general joint="hinge" gainprm="2"/>', "force", ""),
        ('<general joint="hinge" biastype="affine" gainprm="2" biasprm="0 -3 0"/>', "position", ""),
        ('<general joint="hinge" biastype="affine" gainprm="2" biasprm="1 0 0"/>', "", ""),
        ('<muscle joint="hinge" lengthrange="0 1"/>', "", ""),
    ],
)
def test_what_a_set_point_means(actuator: str, meaning: str, unit: str) -> None:
    model = mujoco.MjModel.from_xml_string(MODEL.format(actuator))
    assert set_point_meaning(model, 0) == (meaning, unit)
