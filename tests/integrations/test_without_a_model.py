"""What needs the local model says so, and how to get one, where a client has none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from urlab_client import URLabClient, URLabError
from urlab_client.integrations.gym import URLabEnv
from urlab_client.integrations.ik import InverseKinematics, hand_frames
from urlab_client.integrations.record import record
from urlab_client.integrations.teleop import HandControl, TeleopCommand, teleoperate_blocking
from urlab_client.server import SimulatedServer
from urlab_client.sync._facade import aio_of


@pytest.fixture(scope="module")
def client() -> Iterator[URLabClient]:
    with (
        SimulatedServer("arm", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct", local_model=False) as made,
    ):
        made.discover()
        yield made


def puppet(client: URLabClient) -> None:
    client.runtime.set_mode("puppet")
    try:
        client.step()
    finally:
        client.runtime.set_mode("direct")


@pytest.mark.parametrize(
    "call",
    [
        puppet,
        lambda client: client.articulations["arm"].root_lin_vel_w,
        InverseKinematics,
        HandControl,
        lambda client: teleoperate_blocking(client, lambda _: TeleopCommand()),
        lambda client: URLabEnv(client=client, observations=("qpos",)).reset(),
        lambda client: record(client, "poses.mcap", pose_hz=10.0).__enter__(),
    ],
    ids=["puppet", "velocity", "ik", "hand", "teleop", "env", "poses"],
)
def test_it_says_what_is_missing_and_how_to_get_it(
    client: URLabClient, call: Callable[[URLabClient], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(URLabError) as refused:
        call(client)
    assert "model" in str(refused.value)
    assert "local_model=True" in (refused.value.hint or "")
    assert not list(tmp_path.iterdir())


def test_the_rest_works_without_one(client: URLabClient) -> None:
    arm = client.articulations["arm"]
    arm.set_ctrl({"elbow": 0.5})
    before = client.step_count
    client.step(n_steps=3)
    assert client.step_count == before + 3
    assert client.model is None
    assert hand_frames(aio_of(client), aio_of(arm)) == []
