"""The simulated server's beta over a raw socket: jobs of the editor, statement by statement."""

from __future__ import annotations

import re
import threading
from pathlib import Path
from typing import Any

import pytest
from beta_bench import Bench
from waiting import DEADLINE_S
from wire import Wire

from urlab_client.server import SimulatedServer
from urlab_client.server.editor.jobs import EditorJobs
from urlab_client.server.refusal import Refusal
from urlab_client.server.system.threads import Health


def test_jobs(bench: Bench, tmp_path: Path) -> None:
    """Beta statement 57. Generation 2 statements 1, 2, 3, 4, 5, 6 and 7."""
    started = [bench.raw("create_level", name="bench", force_overwrite=True) for _ in range(2)]
    assert all(re.fullmatch(r"job_[1-9][0-9]*", one["job_id"]) for one in started)
    first, second = (int(one["job_id"].removeprefix("job_")) for one in started)
    assert second == first + 1
    for one in started:
        bench.end(one["job_id"])
        assert bench.refused("op_status", job_id=one["job_id"])[0] == "unknown_job"
    missing = bench.job("import_xml", path=str(tmp_path / "nothing.xml"))
    assert (missing["op"], missing["code"]) == ("error", "import_failed")
    assert bench.refused("import_xml")[0] == "missing_field"
    assert bench.job("import_xml", path="")["code"] == "missing_field"
    assert bench.refused("op_status")[0] == "missing_field"
    assert bench.refused("op_status", job_id="")[0] == "bad_request"
    assert bench.refused("op_status", job_id="job_999999")[0] == "unknown_job"


def test_jobs_and_direct_answers_go_in_order(models: Path) -> None:
    """Generation 2 statements 8, 9, 10, 12 and 14."""
    with SimulatedServer(dialect="beta", model_roots=[models]) as server, Wire(server) as wire:
        wire.hello()
        session = {"session_id": wire.session_id}
        started = wire.raw({"op": "import_xml", "path": str(models / "bot.xml"), **session})
        assert [one["blueprint_short_name"] for one in wire.ask("list_blueprints")["blueprints"]] == ["bot"]
        wire.hello()
        done = next(s for s in wire.until("op_status", job_id=started["job_id"]) if s["state"] != "running")
        assert done["result"]["op"] == "import_xml_ok"
        grid = {"blueprint": done["result"]["blueprint_class_path"], "base_actor_id": "g", "count_x": 2, "count_y": 1}
        started = wire.raw({"op": "spawn_grid", **grid, "session_id": wire.session_id})
        done = next(s for s in wire.until("op_status", job_id=started["job_id"]) if s["state"] != "running")
        assert [cell["actor_id"] for cell in done["result"]["actors"]] == ["g_0_0", "g_1_0"]


def test_steps_go_on_beside_a_job(playing: Bench) -> None:
    """Generation 2 statements 7 and 11."""
    done = threading.Event()

    def work() -> dict[str, Any]:
        done.wait(DEADLINE_S)
        return {"op": "save_level_ok"}

    job = playing.core.jobs.start(work)
    with playing.shm() as shm:
        over_memory = shm.call({"op": "op_status", "session_id": playing.wire.session_id, "job_id": job})
    assert over_memory is not None
    assert over_memory["code"] == "wrong_transport"
    before = playing.step()["time"]
    assert playing.step()["time"] > before
    other = playing.raw("import_xml", path="nowhere.xml")
    assert other["op"] == "op_started"
    for started in (job, other["job_id"]):
        assert playing.wire.ask("op_status", job_id=started)["state"] == "running"
    expired = playing.wire.raw({"op": "op_status", "session_id": "gone", "job_id": job})
    assert expired["code"] == "session_expired"
    done.set()
    assert playing.end(job) == {"op": "save_level_ok"}
    assert playing.end(other["job_id"])["code"] == "import_failed"


def test_results_that_nobody_fetches_keep_nobody_out(bench: Bench) -> None:
    jobs = bench.core.jobs
    started = [jobs.start(lambda: {"op": "save_level_ok"}) for _ in range(4096)]
    with jobs.alone():  # all of them have ended
        pass
    assert bench.job("import_xml", path="nowhere.xml")["code"] == "import_failed"
    assert bench.refused("op_status", job_id=started[0])[0] == "unknown_job"
    assert jobs.take(started[-1]) == {"op": "save_level_ok"}


def test_old_results_go() -> None:
    now = 0.0
    jobs = EditorJobs(Health(), clock=lambda: now)

    def ended() -> str:
        job = jobs.start(lambda: {"op": "save_level_ok"})
        with jobs.alone():
            return job

    first = ended()
    now = 299.0
    later = ended()
    now = 301.0
    with pytest.raises(Refusal, match="expired"):
        jobs.take(first)
    assert jobs.take(later) == {"op": "save_level_ok"}
    many = [ended() for _ in range(4097)]
    with pytest.raises(Refusal, match="expired"):
        jobs.take(many[0])
    assert jobs.take(many[1]) is not None
    jobs.close()


def test_removing(bench: Bench) -> None:
    """Generation 2 statement 14."""
    assert bench.job("remove_actor", target="nobody")["code"] == "destroy_failed"
    assert bench.refused("destroy_actor", target="nobody")[0] == "unknown_op"
