"""The checks of `urlab conformance`, one test each: against our servers, or with `--address` against any."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from falsifier import Falsifier, in_request
from relay import Relay
from targets import bench, furnish, server

from urlab_client.conformance import CHECKS, Bench, Check, Choice, Group, Report, Verdict, Wire, run, statement_titles
from urlab_client.conformance.bench import NEEDS

EVERYTHING = Choice(groups=frozenset(Group), measure=False)
# What our servers lack, whatever is open in them.
MESH = "A static mesh becomes a body, and stops being one"


@pytest.mark.opengl
@pytest.mark.parametrize(
    ("generation", "way"),
    [
        ("alpha", "zmq"),
        ("beta", "shm"),
        pytest.param("alpha", "shm", marks=pytest.mark.long),
        pytest.param("beta", "zmq", marks=pytest.mark.long),
    ],
)
async def test_our_server_passes_every_check(generation: str, way: str, tmp_path: Path) -> None:
    shm = way == "shm"
    with server(tmp_path, generation, shm=shm) as served:
        async with bench(served, tmp_path, shm=shm) as made:
            before = await run(made, Choice(measure=False))
            await furnish(made, tmp_path)
            report = await run(made, EVERYTHING)
            assert (report.left, report.stopped) == ([], "")
            assert (await made.ask("current_level"))["level_path"] == "/Game/Levels/lab"
            assert (await made.ask("pie_status"))["state"] == "ready"
            blueprints = (await made.ask("list_blueprints"))["blueprints"]
            assert [row["blueprint_short_name"] for row in blueprints] == ["bot"]
            assert made.wire.transport.stats.over_shm > 100 if shm else made.wire.transport.stats.over_shm == 0
    results = [*before.checks, *report.checks]
    assert [(one.title, one.detail) for one in results if one.verdict is Verdict.DIFFERS] == []
    wanted = {one.title for one in CHECKS if generation in one.dialects and (shm or "shm" not in one.needs)}
    assert {one.title for one in results if one.verdict is Verdict.HOLDS} == wanted - {MESH}


@pytest.fixture(scope="module")
def report(request: pytest.FixtureRequest) -> Report:
    """Return what the checks find at `--address`."""

    async def checked() -> Report:
        config = request.config
        groups = {Group.READ} | {one for one in (Group.PLAY, Group.AUTHOR) if config.getoption(f"--{one}")}
        wire = Wire(str(config.getoption("--address")), 5559, None, shm=False, timeout=10)
        made = Bench(wire)
        try:
            await made.open()
            return await run(made, Choice(groups=frozenset(groups), measure=False))
        finally:
            await wire.aclose()

    return asyncio.run(checked())


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "check" in metafunc.fixturenames:
        checks = CHECKS if metafunc.config.getoption("--address") else []
        metafunc.parametrize("check", checks, ids=lambda check: check.title)


def test_check(report: Report, check: Check) -> None:
    for result in report.checks:
        if result.title == check.title:
            if result.verdict is Verdict.NOT_TRIED:
                pytest.skip(result.detail)
            assert result.verdict is not Verdict.DIFFERS, f"{', '.join(result.statements)}: {result.detail}"


def test_what_a_check_names_is_there() -> None:
    for check in CHECKS:
        assert set(check.statements) <= set(statement_titles())
        assert set(check.needs) <= set(NEEDS)
        assert check.title
        assert check.statements
    assert len({check.title for check in CHECKS}) == len(CHECKS)


@pytest.mark.parametrize("interruption", ["cancelled", "cut"])
async def test_the_level_is_open_again_after_an_interruption(tmp_path: Path, interruption: str) -> None:
    with server(tmp_path, "beta", shm=False) as served:
        async with Relay(served.step_port) as relay, bench(served, tmp_path, port=relay.port) as made:
            await furnish(made, tmp_path)
            running = asyncio.ensure_future(
                run(
                    made,
                    Choice(groups=frozenset({Group.AUTHOR}), measure=False),
                    lambda result, *_: interrupt() if result.group is Group.AUTHOR else None,
                )
            )
            interrupted = False

            def interrupt() -> None:
                nonlocal interrupted
                if not interrupted:
                    interrupted = True
                    running.cancel() if interruption == "cancelled" else relay.cut()

            await asyncio.wait((running,))
            assert interrupted
            assert running.cancelled() == (interruption == "cancelled")
            assert made.undone == 0
            assert (await made.ask("current_level"))["level_path"] == "/Game/Levels/lab"
            assert (await made.ask("pie_status"))["state"] == "ready"
            rows = (await made.ask("list_actors"))["actors"]
            assert [row["actor_id"] for row in rows if row.get("is_articulation")] == ["arm a", ""]
            gone = await made.ask("destroy_asset", asset_path="/Game/Levels/urlab_conformance.urlab_conformance")
            assert gone["was_found"] is False


@pytest.mark.parametrize(
    ("op", "number"),
    [
        ("import_xml", 1),
        ("create_level", 1),
        ("claim_control", 1),
        ("upload_model_commit", 3),
        ("remove_actor", 2),
        ("load_level", 3),
    ],
)
async def test_ctrl_c_in_the_middle_of_a_request_leaves_nothing_behind(tmp_path: Path, op: str, number: int) -> None:
    loop, seen = asyncio.get_running_loop(), 0

    def watch(_request: dict[str, Any]) -> None:
        nonlocal seen
        seen += 1
        if seen == number:
            loop.call_soon_threadsafe(running.cancel)

    with server(tmp_path, "beta", shm=False) as served:
        async with bench(served, tmp_path) as before:
            await furnish(before, tmp_path)
        with Falsifier(served, request=in_request(op, watch)) as relay:
            async with bench(served, tmp_path, port=relay.port) as made:
                groups = frozenset({Group.PLAY if op == "claim_control" else Group.AUTHOR})
                running = asyncio.ensure_future(run(made, Choice(groups=groups, measure=False)))
                with pytest.raises(asyncio.CancelledError):
                    await running
                assert made.left == []
        async with bench(served, tmp_path) as after:
            assert (await after.ask("current_level"))["level_path"] == "/Game/Levels/lab"
            assert after.hello.manager_present
            for robot in after.robots:
                await after.ask("claim_control", articulation=robot.key, control_owner="another client")
            blueprints = (await after.ask("list_blueprints"))["blueprints"]
            assert [row["blueprint_short_name"] for row in blueprints] == ["bot"]
