"""What needs the local model says so, and how to get one, where a client has none."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from urlab_client import URLabClient, URLabError, URLabPDController
from urlab_client.errors import ControllerSchemaViolation, NoSession
from urlab_client.integrations.gym import URLabEnv
from urlab_client.integrations.ik import InverseKinematics, hand_frames
from urlab_client.integrations.record import record
from urlab_client.integrations.teleop import HandControl, TeleopCommand, teleoperate_blocking
from urlab_client.server import ControllerConfig, SimulatedServer
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


def test_what_is_wrong_with_a_call_is_said_before_anything_is_sent(client: URLabClient) -> None:
    arm, requests = client.articulations["arm"], aio_of(client)._session.transport.stats.sent
    for call, said in (
        (lambda: arm.claim(ttl=-1), r"^claim: ttl takes 0 seconds or more, got -1"),
        (lambda: arm.claim(ttl=math.nan), "^claim: ttl"),
        (lambda: arm.apply_xfrc("", force=(0, 0, 1)), "^arm: the root body is not known without a local model; name"),
        (lambda: arm.actuators["elbow"].set_point_for(0.5), "^actuator 'elbow' of 'arm' is not known to be a position"),
        (lambda: client.wait_until(lambda: True, timeout=0), "^wait_until: timeout takes a number above 0, got 0"),
        (lambda: client.wait_until(lambda: True, timeout=-1), "^wait_until: timeout takes a number above 0, got -1"),
    ):
        with pytest.raises(ValueError, match=said):
            call()
    assert aio_of(client)._session.transport.stats.sent == requests
    with URLabClient() as other, pytest.raises(NoSession, match=r"^handshake: discover\(\) was not called"):
        other.handshake()


def test_gains_are_checked_against_the_schema_before_they_are_sent() -> None:
    with (
        SimulatedServer("arm", play=True, controllers={"arm": ControllerConfig(kp=40.0, kv=4.0)}) as server,
        URLabClient(**server.client_options(), step_mode="direct", local_model=False) as gentle,
    ):
        gentle.discover()
        controller = gentle.articulations["arm"].controller
        assert isinstance(controller, URLabPDController)
        assert len(controller.kp) == len(list(controller.kp)) == len(gentle.articulations["arm"].actuators)
        assert repr(controller.kp) == repr(dict(controller.kp))
        sent = aio_of(gentle)._session.transport.stats.sent
        wrong: list[tuple[dict[str, Any], str]] = [
            ({"kq": 1.0}, "no parameter is called 'kq'; available: .*kp"),
            ({"kp": 3.0}, "kp takes a mapping of actuator name to number, got 3.0"),
            ({"kp": {"elbw": 3.0}}, "kp: no actuator 'elbw'; available: .*elbow"),
            ({"kp": {"elbow": "stiff"}}, r"kp\['elbow'\] takes a number, got 'stiff'"),
            ({"kp": {"elbow": True}}, r"kp\['elbow'\] takes a number, got True"),
            ({"kp": {"elbow": -0.5}}, r"kp\['elbow'\] must be at least 0, got -0.5"),
            ({"default_kp": "stiff"}, "default_kp takes a number, got 'stiff'"),
            ({"default_kp": -1.0}, "default_kp must be at least 0, got -1.0"),
        ]
        for params, said in wrong:
            with pytest.raises(ControllerSchemaViolation, match=f"arm: {said}.*Nothing was sent"):
                controller.configure(**params)
        assert aio_of(gentle)._session.transport.stats.sent == sent
        assert controller.configure(kp={"elbow": 0.0})["kp"]["elbow"] == controller.kp["elbow"] == 0.0
