"""A client that a code generator makes from the console's OpenAPI document, and that drives a robot."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import subprocess
import sys
from collections.abc import AsyncGenerator, Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from http_served import served
from starlette.applications import Starlette
from starlette.routing import Mount
from waiting import DEADLINE_S

from urlab_client.aio import URLabClient
from urlab_client.server import SimulatedServer
from urlab_client.web import Access, app

# The generator has to be told that pictures are bytes.
SETTINGS = """
content_type_overrides:
  image/jpeg: application/octet-stream
  image/png: application/octet-stream
  text/plain: text/html
post_hooks: []
"""

Generate = Callable[[bytes], Callable[[str], ModuleType]]


@pytest.fixture
def generate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generate:
    """Generate a client from a document, and return what imports its modules; a warning is a failure."""

    def made(document: bytes) -> Callable[[str], ModuleType]:
        (tmp_path / "openapi.json").write_bytes(document)
        (tmp_path / "settings.yml").write_text(SETTINGS, encoding="utf-8")
        command = [sys.executable, "-m", "openapi_python_client", "generate", "--path", "openapi.json"]
        command += [
            "--config",
            "settings.yml",
            "--meta",
            "none",
            "--output-path",
            "console_client",
            "--fail-on-warning",
        ]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        monkeypatch.syspath_prepend(tmp_path)
        return lambda name: importlib.import_module(f"console_client.{name}")

    return made


@pytest.mark.long
async def test_a_generated_client_drives_a_robot(generate: Generate) -> None:
    with SimulatedServer("arm", play=True) as server:
        async with URLabClient(**server.client_options()) as client:
            access = Access()
            console = app(client, access=access)

            @contextlib.asynccontextmanager
            async def lifespan(_: Starlette) -> AsyncGenerator[None]:
                async with console.router.lifespan_context(console):
                    yield

            async with served(Starlette(routes=[Mount("/lab", console)], lifespan=lifespan)) as http:
                entered = await http.post("/lab/api/session", json={"token": access.invite()})
                key = entered.json()["key"]
                found = await http.get("/lab/api/openapi.json", headers={"authorization": f"Bearer {key}"})
                part = await asyncio.to_thread(generate, found.content)
                models = part("models")
                url = str(http.base_url).rstrip("/") + found.json()["servers"][0]["url"]
                async with part("client").AuthenticatedClient(base_url=url, token=key) as robots:

                    async def ask(name: str, **given: Any) -> Any:
                        answer = await part(f"api.{name}").asyncio(client=robots, **given)
                        assert not isinstance(answer, models.Error), answer
                        return answer

                    async with asyncio.timeout(DEADLINE_S):
                        while not (world := await ask("console.world")).articulations:
                            pass
                    [arm] = world.articulations
                    index = next(joint.index for joint in arm.joints if joint.name == "elbow")
                    mode = await ask("runtime.set_mode", body=models.SetMode(mode="direct"))
                    assert mode.current_mode == "direct"
                    elbow = models.CtrlBody.from_dict({arm.key: {"elbow": 0.5}})
                    await ask("console.ctrl", body=elbow)
                    stepped = await ask("console.step_many", body=models.StepRequest(n_steps=1500))
                    assert stepped.step == 1500
                    async with asyncio.timeout(DEADLINE_S):
                        while (state := await ask("console.state")).step < stepped.step:
                            pass
                    assert state.articulations[arm.key].qpos[index] == pytest.approx(0.5, abs=0.05)
                    speed = await ask("runtime.set_sim_speed", body=models.SetSimSpeed(percent=300))
                    assert speed.percent == 100
                    missing = await part("api.console.body").asyncio(client=robots, id=10_000)
                    assert isinstance(missing, models.Error)
