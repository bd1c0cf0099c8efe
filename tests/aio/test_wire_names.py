"""Whatever a user calls a robot, or a body of one, means it in every op, and comes back as it was written."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Literal

import pytest

from urlab_client import URLabClient
from urlab_client.errors import UnknownArticulation, UnknownBody
from urlab_client.protocol.base import DialectName
from urlab_client.server import SimulatedServer

CART = """
<mujoco model="cart"><worldbody>
  <body name="goal" mocap="true"><geom name="mark" size="0.1" contype="0" conaffinity="0"/></body>
  <body name="deck" pos="0 0 0.9"><geom name="top" type="box" size="1 1 0.1"/></body>
  <body name="load" pos="0 0 1.05"><joint type="slide" axis="0 0 1"/><geom name="box" size="0.1"/></body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module", params=[(d, n) for d in ("alpha", "beta") for n in ("plugin", "model")], ids=str)
def client(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[URLabClient]:
    dialect: DialectName
    naming: Literal["model", "plugin"]
    dialect, naming = request.param
    folder = tmp_path_factory.mktemp("carts")
    models = [folder / "my-cart.xml", folder / "other.xml"]
    for model in models:
        model.write_text(CART)
    with (
        SimulatedServer(*models, play=True, dialect=dialect, actor_names=naming) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        client.step()
        yield client


def names(client: URLabClient) -> list[str]:
    """Key, actor id and engine's object name of one robot."""
    art = client.articulations["my-cart"]
    return list(dict.fromkeys((art.prefix, "my-cart", art.compiled_prefix)))


def test_bodies(client: URLabClient) -> None:
    for number, (robot, between) in enumerate(itertools.product(names(client), "_/")):
        written = f"{robot}{between}goal"
        pose = client.runtime.set_mocap_pose(written, pos=(number, 0, 0))
        assert (pose.body, pose.pos[0]) == (written, number)
        assert client.runtime.read_mocap_pose(written) == pose
    with pytest.raises(KeyError, match=r"body 'goal' is ambiguous: it could mean '\w+_goal' or '\w+_goal'"):
        client.runtime.read_mocap_pose("goal")
    with pytest.raises(UnknownBody):
        client.runtime.read_mocap_pose("nobody_goal")


def test_elements(client: URLabClient) -> None:
    robot = client.articulations["my-cart"]
    [(name, joint)] = robot.joints.items()
    for called, between in itertools.product(names(client), "_/"):
        assert robot.joints[f"{called}{between}{name}"] is joint
        assert robot.bodies[f"{called}{between}load"] is robot.bodies["load"]
        assert client.entities[called] is client.articulations[called] is robot


def test_contacts(client: URLabClient) -> None:
    compiled = client.articulations["my-cart"].compiled_prefix
    for robot in names(client):
        found = client.runtime.get_contacts(body1=f"{robot}_load", geom2=f"{robot}/top")
        assert {(c.body1, c.geom2) for c in found.contacts} == {(f"{robot}_load", f"{robot}/top")}
        assert {(c.geom1, c.body2) for c in found.contacts} == {(f"{compiled}_box", f"{compiled}_deck")}
    assert len(client.runtime.get_contacts().contacts) == 2 * len(found.contacts)
    assert not client.runtime.get_contacts(body1="nobody_deck").contacts


def test_robots(client: URLabClient) -> None:
    for number, robot in enumerate(names(client)):
        client.runtime.set_twist(robot, linear=(number + 1, 0, 0))
        client.step()
        assert client.articulations[robot].twist_linear[0] == number + 1
        client.runtime.set_control_source("zmq", articulation=robot)
        for by_name in (True, False):
            client.runtime.set_qpos(robot, [0.01 * (number + 1)], by_name=by_name)
            assert client.articulations[robot].qpos_array[0] == pytest.approx(0.01 * (number + 1))
    for call in (
        lambda: client.runtime.set_twist("nobody"),
        lambda: client.runtime.set_qpos("nobody", [0.0]),
        lambda: client.runtime.set_control_source("zmq", articulation="nobody"),
    ):
        with pytest.raises(UnknownArticulation):
            call()
