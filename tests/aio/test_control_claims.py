"""Claims of control: who drives what, against a server of the beta that is written from its wire alone."""

from __future__ import annotations

import asyncio
import logging
import re
from typing import Any

import pytest
from hello import hello_ok
from scripted import ScriptedServer, client_of, names
from scripted_beta import ScriptedBeta, error
from waiting import DEADLINE_S, pass_time, until

from urlab_client import ControlClaimed, NotControlOwner
from urlab_client.aio import URLabClient
from urlab_client.aio.session.control import process_owner
from urlab_client.errors import UnknownArticulation, URLabTimeoutError
from urlab_client.protocol.messages.runtime import ReleaseControl

OURS = process_owner()


@pytest.fixture
def client(beta_client: URLabClient) -> URLabClient:
    return beta_client


async def test_the_first_write_claims_once(client: URLabClient, beta: ScriptedBeta) -> None:
    """Beta statement 69."""
    robot = client.articulations["arm_a"]
    await client.step()
    assert "claim_control" not in names(beta.arrived())
    assert robot.control_owner is None
    robot.set_ctrl({"m": 0.5})
    await client.step()
    await client.step()
    await client.runtime.set_twist("arm_a", linear=(0.1, 0, 0))
    arrived = beta.arrived()
    assert names(arrived) == ["claim_control", "step", "step", "set_twist"]
    claim = arrived[0]
    assert (claim["articulation"], claim["control_owner"], claim["ttl_s"]) == ("arm_a", OURS, 30.0)
    assert all(request["control_owner"] == OURS for request in arrived)
    assert arrived[1]["per_articulation"] == {"arm_a": {"ctrl": [0.5]}}
    assert (beta.owners, robot.control_owner) == ({"arm_C_0": OURS}, OURS)


async def test_writing_into_a_view_held_since_long_is_a_write(client: URLabClient, beta: ScriptedBeta) -> None:
    robot = client.articulations["arm_a"]
    view = robot.ctrl_array
    await robot.claim()
    await robot.release()
    assert beta.owners == {}
    await client.step()
    assert beta.owners == {}
    view[0] = 0.75
    await client.step()
    assert (beta.owners, beta.ctrl["arm_C_0"]) == ({"arm_C_0": OURS}, [0.75])


async def test_looking_at_set_points_is_no_write(client: URLabClient, beta: ScriptedBeta) -> None:
    robot = client.articulations["arm_a"]
    copied, doubled = robot.ctrl_array.copy(), robot.ctrl_array * 2.0
    copied[:] = doubled[:] = 9.0
    assert (robot.ctrl_array.tolist(), robot.get_ctrl()) == ([0.0], {"m": 0.0})
    await client.step()
    assert "claim_control" not in names(beta.arrived())


async def test_writing_what_was_there_already_is_a_write(client: URLabClient, beta: ScriptedBeta) -> None:
    """The server may have other set-points, of an owner from before."""
    robot = client.articulations["arm_a"]
    beta.ctrl["arm_C_0"] = [0.75]
    robot.ctrl_array[:] = 0.0
    await client.step()
    assert (beta.owners, beta.ctrl["arm_C_0"]) == ({"arm_C_0": OURS}, [0.0])
    await robot.release()
    robot.ctrl_array[0] = 0.0
    await client.step()
    assert beta.owners == {"arm_C_0": OURS}


async def test_what_was_changed_past_the_view_and_changed_back_is_sent(client: URLabClient, beta: ScriptedBeta) -> None:
    set_points = client.articulations["arm_a"].ctrl_array
    set_points += 0.5
    await client.step()
    set_points -= 0.5
    await client.step()
    assert beta.ctrl["arm_C_0"] == [0.0]


@pytest.mark.parametrize("said", ["arm_C_0 is taken", "", "the dashboards have it", "belongs to dashboard"])
@pytest.mark.parametrize("code", ["control_claimed", "not_control_owner"])
async def test_a_refusal_names_the_owner_however_it_is_worded(
    client: URLabClient, beta: ScriptedBeta, code: str, said: str
) -> None:
    beta.on("claim_control" if code == "control_claimed" else "step", error(code, said, owner="dashboard"))
    client.articulations["arm_a"].set_ctrl({"m": 0.5})
    with pytest.raises(NotControlOwner, match=r"\bdashboard\b.*force=True") as caught:
        await client.step()
    shown = caught.value.message  # which is also what the console shows
    assert re.findall(r"\bdashboard\b", shown) == ["dashboard"]
    assert said in shown


@pytest.mark.parametrize("mode", ["live", "direct"])
async def test_a_claim_that_ran_out_is_made_once_more(client: URLabClient, beta: ScriptedBeta, mode: str) -> None:
    """Beta statement 70."""
    await client.runtime.set_mode(mode)
    client.articulations["arm_a"].set_ctrl({"m": 0.5})
    await client.step()
    beta.owners.clear()
    beta.arrived()
    await client.step()
    assert names(beta.arrived()) == ["step", "claim_control", "step"]


async def test_a_server_that_never_grants_what_it_claims_to_is_asked_twice(
    client: URLabClient, beta: ScriptedBeta
) -> None:
    """Beta statement 70."""
    beta.on("step", error("not_control_owner", "no", owner="(unclaimed)"))
    client.articulations["arm_a"].set_ctrl({"m": 0.5})
    with pytest.raises(NotControlOwner, match=r"claim\(\)") as caught:
        await client.step()
    assert caught.value.owner == "(unclaimed)"
    assert names(beta.arrived()) == ["claim_control", "step", "claim_control", "step"]


async def test_a_robot_of_somebody_else_is_not_fought_for(client: URLabClient, beta: ScriptedBeta) -> None:
    """Beta statement 70."""
    robot = client.articulations["arm_a"]
    robot.set_ctrl({"m": 0.5})
    await client.step()
    beta.owners["arm_C_0"] = "dashboard"
    beta.arrived()
    with pytest.raises(NotControlOwner, match="force=True") as caught:
        await client.step()
    assert (caught.value.owner, robot.control_owner) == ("dashboard", "dashboard")
    assert names(beta.arrived()) == ["step"]
    with pytest.raises(ControlClaimed) as claimed:
        await client.step()
    assert claimed.value.owner == "dashboard"
    assert names(beta.arrived()) == ["claim_control"]
    await robot.release()
    await client.step()  # it is only looked at, which needs no owner
    assert beta.ctrl["arm_C_0"] == [0.5]
    await robot.claim(force=True)
    await client.step()
    assert beta.owners["arm_C_0"] == OURS


async def test_a_robot_that_is_somebody_elses_does_not_keep_from_driving_ours(
    client: URLabClient, beta: ScriptedBeta
) -> None:
    beta.owners["arm_C_1"] = "dashboard"
    client.articulations["arm_a"].set_ctrl({"m": 0.5})
    await client.step()
    assert beta.ctrl["arm_C_0"] == [0.5]


@pytest.mark.parametrize("reads_owner", [True, False])
async def test_control_survives_a_new_session(reads_owner: bool) -> None:
    """Beta statement 71."""
    beta = ScriptedBeta(reads_owner=reads_owner)
    try:
        async with client_of(beta, step_mode="direct") as client:
            await client.discover()
            client.articulations["arm_a"].set_ctrl({"m": 0.5})
            await client.step()
            await client.discover()
            beta.owners["arm_C_1"] = "dashboard"
            beta.arrived()
            await client.step()
            claims = beta.of("claim_control")
            # The old session may still have it, and that was us.
            assert [claim.get("force", False) for claim in claims] == ([] if reads_owner else [False, True])
            client.articulations["arm_C_1"].set_ctrl({"m": 0.5})
            with pytest.raises(ControlClaimed):
                await client.step()
            assert beta.owners["arm_C_1"] == "dashboard"
    finally:
        beta.close()


async def test_closing_gives_up_what_is_owned(beta: ScriptedBeta) -> None:
    """Beta statement 72."""
    async with client_of(beta, step_mode="direct") as client:
        await client.discover()
        client.articulations["arm_a"].set_ctrl({"m": 0.5})
        await client.articulations["arm_C_1"].claim(ttl=0)
        await client.step()
        assert set(beta.owners) == {"arm_C_0", "arm_C_1"}
    assert beta.owners == {}


async def test_closing_gives_up_a_claim_whose_answer_was_lost(beta: ScriptedBeta) -> None:
    grant = beta.answers["claim_control"]

    def lost(request: dict[str, Any]) -> None:
        grant(request)

    async with client_of(beta, step_mode="direct") as client:
        await client.discover()
        beta.on("claim_control", lost)
        with pytest.raises(URLabTimeoutError):
            await client.articulations["arm_a"].claim(ttl=0, timeout=0.5)
        assert beta.owners == {"arm_C_0": OURS}
    assert beta.owners == {}


async def test_an_idle_claim_is_renewed(client: URLabClient, beta: ScriptedBeta) -> None:
    await client.articulations["arm_a"].claim(ttl=0.15)
    beta.arrived()
    again = await asyncio.to_thread(beta.seen.get, timeout=DEADLINE_S)
    assert (again["op"], again["articulation"], again["ttl_s"]) == ("claim_control", "arm_a", 0.15)
    assert not again.get("force")


async def test_a_claim_made_again_keeps_its_own_time_limit(client: URLabClient, beta: ScriptedBeta) -> None:
    robot = client.articulations["arm_a"]
    await robot.claim(ttl=7.5)
    beta.owners.clear()
    beta.arrived()
    robot.set_ctrl({"m": 0.5})
    await client.step()
    assert [request["ttl_s"] for request in beta.arrived() if request["op"] == "claim_control"] == [7.5]


async def test_a_renewal_that_fails_does_not_lose_the_claim(
    client: URLabClient, beta: ScriptedBeta, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG, "urlab_client.control")
    await client.articulations["arm_a"].claim(ttl=600.0)
    beta.arrived()
    grant = beta.answers["claim_control"]
    beta.on("claim_control", error("internal_error", "the editor is busy"))
    await asyncio.sleep(0)  # the renewals begin
    pass_time(201.0)
    await asyncio.to_thread(beta.request, "claim_control")
    await until(lambda: "could not be renewed" in caplog.text)
    assert client.articulations["arm_a"].control_owner == OURS
    beta.on("claim_control", grant)
    pass_time(201.0)
    again = await asyncio.to_thread(beta.request, "claim_control")
    assert again["ttl_s"] == 600.0, "long before the claim expires"


async def test_an_observer_claims_nothing_by_itself(beta: ScriptedBeta) -> None:
    async with client_of(beta, step_mode="direct", claim_control=False) as client:
        await client.discover()
        robot = client.articulations["arm_a"]
        await client.step()
        robot.set_ctrl({"m": 0.5})
        with pytest.raises(NotControlOwner, match="claim_control=True"):
            await client.step()
        assert beta.of("claim_control") == []
        await robot.claim()
        await client.step()
        assert beta.ctrl["arm_C_0"] == [0.5]


async def test_a_claim_of_a_robot_that_is_gone(client: URLabClient, beta: ScriptedBeta) -> None:
    beta.on("claim_control", error("unknown_articulation", "arm_a"))
    robot = client.articulations["arm_a"]
    with pytest.raises(UnknownArticulation):
        await robot.claim()
    with pytest.raises(ValueError, match="ttl"):
        await robot.claim(ttl=float("nan"))
    await client.step()


async def test_a_new_play_session_is_claimed_anew(client: URLabClient, beta: ScriptedBeta) -> None:
    robot = client.articulations["arm_a"]
    robot.set_ctrl({"m": 0.5})
    await client.step()
    await client.sim.stop()
    assert robot.control_owner is None
    await client.sim.start()
    beta.arrived()
    await client.step()
    assert names(beta.arrived()) == ["claim_control", "step"]


async def test_a_robot_given_up_by_a_bare_request_is_not_claimed_again(client: URLabClient, beta: ScriptedBeta) -> None:
    robot = client.articulations["arm_a"]
    await robot.claim()
    await client.call(ReleaseControl(articulation="arm a"))
    assert robot.control_owner is None
    assert beta.owners == {}


async def test_a_refusal_where_nothing_can_be_claimed() -> None:
    """Beta statement 83."""
    beta = ScriptedBeta(without=("claim_control", "release_control"))
    try:
        async with client_of(beta, step_mode="direct") as client:
            await client.discover()
            assert not client.server.features.claims
            client.articulations["arm_a"].set_ctrl({"m": 0.5})
            with pytest.raises(NotControlOwner):
                await client.step()
            assert len(beta.of("step")) == 1
    finally:
        beta.close()


async def test_an_alpha_never_hears_of_claims(scripted: ScriptedServer) -> None:
    """Beta statement 68."""
    robot = ScriptedBeta.robot(scripted, "arm_C_0", "arm a", "arm_C_0")  # type: ignore[arg-type]  # needs a port
    del robot["actor_name"]
    scripted.on("hello", hello_ok(articulations=[robot]))
    state = {"time": 0.1, "step": 1.0, "per_articulation": {"arm_C_0": {"qpos": [], "qvel": []}}}
    scripted.on("step", {"op": "step_ok", **state})
    scripted.on("set_mode", {"op": "set_mode_ok", "previous_mode": "live", "current_mode": "direct"})
    async with client_of(scripted, step_mode="direct", local_model=False) as client:
        await client.discover()
        robot_of_ours = client.articulations["arm_C_0"]
        robot_of_ours.set_ctrl({"m": 0.5})
        await robot_of_ours.claim(force=True)
        await client.step()
        await robot_of_ours.release()
        assert robot_of_ours.control_owner is None
    seen = []
    while not scripted.seen.empty():
        seen.append(scripted.seen.get())
    assert {"claim_control", "release_control"}.isdisjoint(names(seen))
    assert all("control_owner" not in request for request in seen)


async def test_explain_tells_who_controls_what(beta: ScriptedBeta) -> None:
    async with client_of(beta, step_mode="direct", claim_control=False) as client:
        await client.discover()
        mine, theirs = client.articulations["arm_a"], client.articulations["arm_C_1"]

        async def told(about: str) -> str:
            return " ".join(f.text for f in (await client.explain()).findings if f.subject == about)

        assert "The first write claims it" in await told("arm_a")
        mine.set_ctrl({"m": 0.5})
        assert "articulation.claim()" in await told("arm_a")
        await mine.claim()
        assert "This client controls it" in await told("arm_a")
        beta.owners["arm_C_1"] = "dashboard"
        with pytest.raises(ControlClaimed):
            await theirs.claim()
        assert "'dashboard' controls it" in await told("arm_C_1")
