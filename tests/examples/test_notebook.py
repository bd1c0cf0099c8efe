"""What a notebook shows: tables, pictures and curves instead of reprs, which stay one line in a terminal."""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.aio import URLabClient as AsyncClient
from urlab_client.integrations.record import read_run, record
from urlab_client.protocol.messages.streams import CameraSample
from urlab_client.server import SimulatedServer
from urlab_client.values.html import curve, fields, table

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"

EXECUTE = """
import nbclient, nbformat, sys
notebook = nbformat.read(sys.argv[1], 4)
nbclient.NotebookClient(notebook, timeout=240, kernel_name="python3").execute()
print(nbformat.writes(notebook))
"""

PENDULUM = """
<mujoco><worldbody><body name="bob"><joint name="swing" axis="0 1 0"/><geom size=".1"/></body></worldbody>
<actuator><motor name="swing" joint="swing"/></actuator></mujoco>
"""


@pytest.fixture
def model(tmp_path: Path) -> str:
    path = tmp_path / "pendulum.xml"
    path.write_text(PENDULUM)
    return str(path)


def html_of(value: Any) -> str:
    shown: str = value._repr_html_()
    assert "\n" not in repr(value), "a terminal shows one line"
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]*>", " ", shown))).strip()


@pytest.mark.long
@pytest.mark.opengl
def test_the_notebook_shows_values(tmp_path: Path) -> None:
    own = {f"JUPYTER_{kind}_DIR": str(tmp_path / kind) for kind in ("RUNTIME", "CONFIG", "DATA")}
    done = subprocess.run(
        [sys.executable, "-c", EXECUTE, NOTEBOOK],
        cwd=tmp_path,
        env={**os.environ, **own, "IPYTHONDIR": str(tmp_path / "ipython")},
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    cells = [cell for cell in json.loads(done.stdout)["cells"] if cell["cell_type"] == "code"]
    shown = ["".join(cell["source"]).splitlines()[-1] for cell in cells]
    data = [output["data"] for cell in cells for output in cell["outputs"] if "data" in output]
    assert len(data) == len(shown) - 1, "every cell but close() shows its last value"
    assert sum("image/png" in one for one in data) == 2, "a picture that was taken, and one that is redrawn"
    assert all(len("".join(one["text/plain"]).splitlines()) == 1 for one in data)


def test_blocking_objects_show_tables(model: str) -> None:
    with (
        SimulatedServer(model, play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        assert "step mode direct, requested" in html_of(client)
        client.discover()
        said = html_of(client)
        assert "robots pendulum" in said
        assert "play ready, waiting for step()" in said
        assert html_of(client.articulations["pendulum"]).startswith("URLabArticulation 'pendulum'")
        assert "swing" in html_of(client.articulations["pendulum"])
        assert "pendulum" in html_of(client.articulations)
        robot = client.articulations["pendulum"]
        assert html_of(robot.joints) == "joints name kind unit limits position velocity swing hinge rad 0 0"
        assert html_of(robot.actuators).startswith("actuators name kind joint takes unit")
        assert html_of(robot.joints["swing"]).startswith("Joint 'swing' hinge id=0 name swing kind hinge unit rad")
        assert html_of(robot.sensors) == "sensors"
        step = html_of(client.step())
        assert step.startswith("StepOk time 0.002 s step 1")
        assert "wall" not in step, "a row for each robot's field, and no second clock"
        assert re.search(r"pendulum qpos \[.*\] qvel", step)
        assert repr(client.articulations["pendulum"].joints["swing"]) == "<Joint 'swing' hinge id=0>"
        assert repr(client.articulations["pendulum"].actuators["swing"]) == "<Actuator 'swing' motor id=0>"
        assert repr(client).endswith(" connected, direct at 0.002 s: pendulum>")
        diagnosis = client.explain()
        assert "play" in html_of(diagnosis)
        assert "#2e7d32" in str(diagnosis._repr_html_()), "what is in order is green"
        assert "play ready, waiting for step()" in html_of(client)
        client.sim.stop()
        assert "play not running, as far as this client knows" in html_of(client)
    assert "closed" in html_of(client)
    assert "step mode" not in html_of(client)


async def test_async_objects_show_tables(model: str) -> None:
    with SimulatedServer(model, play=True) as server:
        async with AsyncClient(**server.client_options()) as client:
            await client.discover()
            assert "swing" in html_of(client.articulations["pendulum"])
            sent = client.transport_stats.sent
            assert "connected" in html_of(client)
            assert client.transport_stats.sent == sent


def test_a_recording_shows_its_curves(model: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with (
        SimulatedServer(model, play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        recorder = record(client, path)
        assert repr(recorder) == f"<Recorder {str(path)!r} not begun, 0 states, 0 pictures>"
        with recorder:
            client.articulations["pendulum"].set_ctrl({"swing": 1.0})
            for _ in range(5):
                client.step()
    run = read_run(path)
    assert re.search(r"joint positions from 0\.00 to 0\.01 s pendulum/swing \S+ to \S+ angle \(rad\)", html_of(run))
    table = run.table()
    assert repr(table) == "<Table states: 5, 0.002 to 0.010 s, columns: 5>"
    assert re.search(r"pendulum/qpos 1 swing \[0\.\d+\] \[0\.\d+\]", html_of(table)), "its first and last values"
    assert "<polyline" in run._repr_html_()
    path.unlink()
    assert "problem" in html_of(run)


def test_pictures_show_themselves() -> None:
    depth = np.linspace(1, 4, 12, dtype=np.float32).reshape(3, 4)
    for pixels, mode in ((depth, "depth"), (np.zeros((3, 4, 4), np.uint8), "real")):
        sample = CameraSample(camera="eye", mode=mode, pixels=pixels)
        assert sample._repr_html_() is None
        assert (sample._repr_png_() or b"").startswith(b"\x89PNG")
        assert "4x3" in repr(sample)


@pytest.mark.opengl
def test_a_step_shows_its_pictures() -> None:
    with (
        SimulatedServer("arm", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        reply = client.step(include_cameras={"arm/overview": "sync"})
    assert reply.cameras is not None
    shown = reply._repr_html_() or ""
    assert 'src="data:image/png;base64,' in shown
    assert " bytes" not in shown
    picture = reply.cameras["arm/overview"]
    assert picture._repr_html_() is None
    assert (picture._repr_png_() or b"").startswith(b"\x89PNG")


def test_names_are_escaped() -> None:
    assert "<script>" not in table([("<script>", {"<script>": "<script>"})], heads=["<script>"], caption="<script>")


def test_long_tables_are_cut() -> None:
    many = fields("", {"rows": [{"n": n} for n in range(1000)], "values": np.zeros(1000)})
    assert "950 more" in many
    assert "(1000)" in many
    assert len(many) < 10_000


def test_rounding_noise_is_a_straight_line() -> None:
    heights = {point.split(",")[1] for point in re.findall(r"[\d.]+,[\d.]+", curve(1e-14 * np.sin(np.arange(50.0))))}
    assert len(heights) == 1
    assert curve([1.0]) == ""


def test_rounding_noise_is_zero_rows_of_numbers_stay_on_a_line_and_clocks_are_seconds() -> None:
    shown = fields("", {"qpos": np.array([8.49e-15, -0.4, 1e-3]), "at": {"sec": 3, "nsec": 250_000_000}, "one": -2e-16})
    assert "[0, -0.4, 0.001]" in shown
    assert "3.250 s" in shown
    assert "e-1" not in shown
    assert re.search(r'nowrap">\[0, ', shown)
