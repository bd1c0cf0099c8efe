"""Models that viewers import: what the server gets of them, what they cannot do, and what they never replace."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import re
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from forked import COMMAND, program
from msgspec.structs import replace
from starlette.testclient import TestClient
from test_web_api import mounted

from urlab_client.aio import URLabClient
from urlab_client.aio.model import compilation
from urlab_client.aio.model.upload import flatten
from urlab_client.console import model_import, recordings
from urlab_client.console.session import ConsoleSession
from urlab_client.server import SimulatedServer
from urlab_client.web import Access

BALL = "<mujoco><worldbody><body name='b'><joint name='j'/><geom size='.1'/></body></worldbody></mujoco>"
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
WITH_MESH = BALL.replace("<worldbody>", "<asset><mesh name='m' file='{}'/></asset><worldbody>").replace(
    "size='.1'", "type='mesh' mesh='m'"
)


@pytest.fixture(autouse=True)
def import_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which consoles hand models to servers: not that of whoever runs the tests."""
    monkeypatch.setenv("URLAB_REGISTRY_DIR", str(tmp_path / "registry"))
    return tmp_path / "registry" / "imports"


@contextlib.contextmanager
def console(server: SimulatedServer, tmp_path: Path, **options: Any) -> Iterator[TestClient]:
    """A page's view of a console that has just begun to connect."""
    site = mounted(server, "/", Access(hosts=["localhost"], tokens=False), tmp_path / "recordings", **options)
    with TestClient(site, base_url="http://localhost") as http:
        yield http


@pytest.fixture(params=["alpha", "beta"])
def http(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[TestClient]:
    with SimulatedServer("arm", dialect=request.param) as server, console(server, tmp_path) as client:
        yield client


@pytest.fixture
def compiled_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of what happens to compiled models: no child process, which takes half a second."""
    monkeypatch.setattr(model_import, "flatten_confined", lambda file, _progress: flatten(file))


@pytest.fixture
def nothing_handed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if servers could not read what this machine hands over."""
    monkeypatch.setattr(model_import, "import_directory", lambda: tmp_path / "nobody reads it")


def zipped(**files: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(name.replace("__", "/").replace("_dot_", "."), content)
    return buffer.getvalue()


CRATE = zipped(robot__robot_dot_xml=WITH_MESH.format("m/t.obj"), robot__m__t_dot_obj=MESH)


def blueprints(http: TestClient) -> list[str]:
    listed = http.post("/api/ops/list_blueprints", json={}).json()["blueprints"]
    return [one["blueprint_short_name"] for one in listed]


def refusal(answer: Any, status: int = 400) -> str:
    assert answer.status_code == status, answer.text
    return str(answer.json()["error"]["message"])


def test_models_are_imported_by_their_names(http: TestClient, import_folder: Path) -> None:
    made = http.put("/api/models/my crate.zip", content=CRATE).json()
    assert blueprints(http) == ["arm", made["name"]]
    spawned = http.post("/api/ops/spawn_actor", json={"blueprint": made["blueprint"], "actor_id": "it"})
    assert spawned.status_code == 200, spawned.text
    assert list(import_folder.iterdir()) == []


@pytest.mark.usefixtures("compiled_here", "nothing_handed_over")
def test_a_model_that_comes_before_the_session_waits_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = asyncio.Event()
    discover, opened = URLabClient.discover, ConsoleSession.opened

    async def late(client: URLabClient) -> None:
        await asked.wait()
        await discover(client)

    async def waited_for(console: ConsoleSession) -> None:
        asyncio.get_running_loop().call_later(0.3, asked.set)
        await opened(console)

    monkeypatch.setattr(URLabClient, "discover", late)
    monkeypatch.setattr(ConsoleSession, "opened", waited_for)
    with SimulatedServer("arm", dialect="beta") as server, console(server, tmp_path) as http:
        assert http.put("/api/models/crate.xml", content=BALL).json().get("name") == "model"


@pytest.mark.usefixtures("compiled_here")
def test_another_blueprint_is_replaced_only_by_name(http: TestClient) -> None:
    assert http.put("/api/models/crate.xml", content=BALL).status_code == 200
    for allowed in ("", "?replace=", "?replace=model", "?replace=arm"):
        refused = http.put(f"/api/models/crate.xml{allowed}", content=BALL)
        assert refused.status_code == 409
        error = refused.json()["error"]
        assert (error["code"], error["name"]) == ("would_replace", "crate")
        assert "?replace=crate" in error["hint"]
    assert http.put("/api/models/crate.xml?replace=crate", content=BALL).status_code == 200


@pytest.mark.usefixtures("compiled_here", "nothing_handed_over")
@pytest.mark.parametrize("http", ["beta"], indirect=True)
def test_an_upload_that_goes_over_the_wire_says_what_it_replaces(http: TestClient) -> None:
    """Statement 9.2 of beta.md: every upload makes the class `model`."""
    assert http.put("/api/models/crate.xml", content=BALL).json()["name"] == "model"
    refused = http.put("/api/models/ball.xml", content=BALL)
    assert "'model'" in refusal(refused, 409)
    assert refused.json()["error"]["name"] == "model"
    assert http.put("/api/models/ball.xml?replace=ball", content=BALL).status_code == 409
    assert http.put("/api/models/ball.xml?replace=model", content=BALL).json()["name"] == "model"
    assert blueprints(http) == ["arm", "model"]


@pytest.mark.usefixtures("compiled_here", "nothing_handed_over")
@pytest.mark.parametrize("http", ["alpha"], indirect=True)
def test_a_server_that_can_neither_read_nor_receive_a_model_says_so(http: TestClient, tmp_path: Path) -> None:
    said = refusal(http.put("/api/models/crate.xml", content=BALL), 409)
    last = http.get("/api/log").json()[-1]
    assert (last["kind"], last["what"], last["text"]) == ("error", "import model", f"crate.xml: {said}")
    assert said.startswith("crate.xml lies outside the folders this server may read models from")
    assert str(tmp_path) not in said


def test_a_console_without_a_server_does_not_wait_for_ever(tmp_path: Path) -> None:
    server = SimulatedServer("arm").start()
    with console(server, tmp_path, rcv_timeout_ms=100) as http:
        server.close()
        assert "session" in refusal(http.put("/api/models/ball.xml", content=BALL), 503)


@pytest.mark.parametrize("http", ["beta"], indirect=True)
def test_a_viewers_model_reads_nothing_of_the_consoles_machine(http: TestClient, tmp_path: Path) -> None:
    secret = tmp_path / "secret.obj"
    secret.write_text(MESH)
    said = [
        refusal(http.put("/api/models/m.xml", content=WITH_MESH.format(file))).replace(str(file), "FILE")
        for file in (secret, tmp_path / "missing.obj")
    ]
    assert said[0] == said[1] == "m.xml names FILE: a model may name only files that come with it, by relative paths"
    assert blueprints(http) == ["arm"]


@pytest.mark.parametrize("http", ["beta"], indirect=True)
def test_a_viewers_model_takes_no_more_time_than_it_may(http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    replicated = "<replicate count='100'>" * 4 + "<geom size='.1'/>" + "</replicate>" * 4
    limits = replace(compilation.UPLOAD_LIMITS, cpu_s=1, memory_bytes=2**33)  # more than it can take in a second
    monkeypatch.setattr(compilation, "UPLOAD_LIMITS", limits)
    bomb = f"<mujoco><worldbody>{replicated}</worldbody></mujoco>"
    assert "1 s of processor time" in refusal(http.put("/api/models/m.xml", content=bomb))
    monkeypatch.setattr(compilation, "UPLOAD_LIMITS", replace(compilation.UPLOAD_LIMITS, wall_s=0))
    assert "took more than 0 s" in refusal(http.put("/api/models/m.xml", content=bomb))
    assert blueprints(http) == ["arm"]


@pytest.mark.parametrize("http", ["beta"], indirect=True)
@pytest.mark.parametrize("name", ["robot.urdf", "x" * 250 + ".xml", "CON.xml", "a%00b.xml", "a%5Cb.xml", "..%5Ca.zip"])
def test_names_that_are_not_those_of_models_are_refused(http: TestClient, name: str) -> None:
    assert "not the name of a model" in refusal(http.put(f"/api/models/{name}", content=BALL))


@pytest.mark.parametrize("http", ["beta"], indirect=True)
def test_a_damaged_archive_is_refused_with_a_reason(http: TestClient) -> None:
    broken = bytearray(CRATE)
    broken[60] ^= 0xFF  # in the first file: its checksum is wrong now
    said = refusal(http.put("/api/models/crate.zip", content=bytes(broken)))
    assert "Bad CRC-32" in said
    last = http.get("/api/log").json()[-1]
    assert (last["kind"], last["what"], last["text"]) == ("error", "import model", f"crate.zip: {said}")
    assert "not a ZIP archive" in refusal(http.put("/api/models/crate.zip", content=b"nonsense"))


def test_what_a_viewer_sends_may_be_so_large_and_no_larger(http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = b"{}"
    monkeypatch.setattr(model_import, "_LARGEST_FILE", len(BALL))
    monkeypatch.setattr(recordings, "_LARGEST_FILE", len(robot))
    assert http.put("/api/models/ball.xml", content=BALL).status_code == 200
    assert f"at most {len(BALL)} bytes" in refusal(http.put("/api/models/ball.xml", content=BALL + " "))
    assert "at most" not in refusal(http.put("/api/recordings/run.json", content=robot), 409)
    assert f"at most {len(robot)} bytes" in refusal(http.put("/api/recordings/run.json", content=robot + b" "))


def test_a_model_is_imported_by_a_console_as_it_is_started(tmp_path: Path) -> None:
    with program(COMMAND, "console", "sim://arm", "--port=0", cwd=tmp_path) as process:
        assert process.stdout is not None
        found = re.search(r"(http://\S+)/\?token=(\S+)", process.stdout.readline())
        assert found is not None

        def ask(method: str, path: str, body: bytes, **headers: str) -> Any:
            request = urllib.request.Request(f"{found[1]}/api/{path}", body, headers, method=method)
            with urllib.request.urlopen(request) as answer:
                return json.load(answer)

        key = ask("POST", "session", json.dumps({"token": found[2]}).encode())["key"]
        made = ask("PUT", "models/crate.zip", CRATE, authorization=f"Bearer {key}")
        assert made == {"blueprint": "/Game/MuJoCoImports/crate.crate_C", "name": "crate"}
