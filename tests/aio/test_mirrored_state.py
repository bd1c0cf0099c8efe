"""What a reply leaves behind: in the local data, and in the client's clocks."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.aio.model.articulation_state import MirroredArticulation
from urlab_client.aio.model.layout import articulation_layouts
from urlab_client.aio.model.mirror import Loaded, Mirror
from urlab_client.protocol.messages.session import ArticulationInfo, ArticulationState
from urlab_client.server import SimulatedServer

INTERLEAVED = """
<mujoco>
  <worldbody>
    <body name="one_base"><joint name="one_low"/><geom size="0.1"/>
      <body name="two_base"><joint name="two_low"/><geom size="0.1"/>
        <body name="one_tip"><joint name="one_high"/><geom size="0.1"/>
          <body name="two_tip"><joint name="two_high"/><geom size="0.1"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="one_low" joint="one_low"/><motor name="two_low" joint="two_low"/>
    <motor name="one_high" joint="one_high"/><motor name="two_high" joint="two_high"/>
  </actuator>
</mujoco>
"""


def test_robots_whose_values_lie_between_each_others_are_mirrored_each_in_its_places() -> None:
    model = mujoco.MjModel.from_xml_string(INTERLEAVED)
    mirror = Mirror()
    mirror.use(Loaded(model, mujoco.MjData(model), approximate=False))
    for name, layout in articulation_layouts(model, {"one": "one", "two": "two"}).items():
        record = MirroredArticulation(mirror, ArticulationInfo(prefix=name, actor_id=name), layout)
        first = 1.0 if name == "one" else 5.0
        qpos, qvel, ctrl = (np.array([first + 10 * i, first + 10 * i + 1]) for i in range(3))
        record.absorb(ArticulationState(qpos=qpos, qvel=qvel, ctrl=ctrl, act=np.zeros(2)), into_mirror=True)
    assert mirror.data is not None
    assert mirror.data.qpos.tolist() == [1, 5, 2, 6]
    assert mirror.data.qvel.tolist() == [11, 15, 12, 16]
    assert mirror.data.ctrl.tolist() == [21, 25, 22, 26]


def test_one_robot_among_others_is_mirrored_where_the_server_has_it() -> None:
    with (
        SimulatedServer("arm", "arm", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        first, second = client.articulations.values()
        first.ctrl_array[:], second.ctrl_array[:] = 0.1, -0.2
        reply = client.step(20)
        states = [reply.per_articulation[robot.prefix] for robot in (first, second)]
        data: Any = client.data
        assert data.qpos.tolist() == np.concatenate([state.qpos for state in states]).tolist()
        assert data.qvel.tolist() == np.concatenate([state.qvel for state in states]).tolist()
        assert data.ctrl.tolist() == np.concatenate([first.last_applied_ctrl, second.last_applied_ctrl]).tolist()
        assert not np.array_equal(states[0].qpos, states[1].qpos)


def test_the_clocks_of_a_reply_are_the_clients_and_nobody_can_change_them() -> None:
    with (
        SimulatedServer("ball", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        reply: Any = client.step(3)
        with pytest.raises(AttributeError):
            reply.sim_time.sec = 7
        assert (client.sim_time_sec, client.sim_time_nsec) == (reply.sim_time.sec, reply.sim_time.nsec)
        assert (client.wall_time_sec, client.wall_time_nsec) == (reply.wall_time.sec, reply.wall_time.nsec)
