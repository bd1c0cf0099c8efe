"""How an articulation comes by its controller: an option of the server, the level, or its own MJCF, in that order."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from urlab_client import URLabClient, URLabPDController
from urlab_client.server import ControllerConfig, ModelError, SimulatedServer

MODEL = """
<mujoco model="lever">
  <custom>{text}</custom>
  <worldbody>
    <body name="bar"><joint name="hinge" axis="0 1 0"/><geom type="capsule" size="0.02 0.2" mass="1"/></body>
  </worldbody>
  <actuator><motor name="drive" joint="hinge"/></actuator>
</mujoco>
"""


def write(folder: Path, data: str | None, name: str = "lever") -> Path:
    file = folder / f"{name}.xml"
    text = "" if data is None else f'<text name="urlab_controller" data="{data}"/>'
    file.write_text(MODEL.format(text=text))
    return file


def controllers(server: SimulatedServer) -> dict[str, Any]:
    """Kind and proportional gain by articulation; None without a controller."""
    with URLabClient(**server.client_options(), step_mode="direct") as client:
        client.discover()
        found: dict[str, Any] = {}
        for key, articulation in client.articulations.items():
            controller = articulation.controller
            gain = dict(controller.kp) if isinstance(controller, URLabPDController) else {}
            found[key] = None if controller is None else (controller.kind, *gain.values())
        return found


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (None, None),
        ("pd", ("pd", 100.0)),
        ("pd, kp=30, kv=2", ("pd", 30.0)),
        ("passthrough", ("passthrough",)),
    ],
)
def test_an_mjcf_names_its_controller(tmp_path: Path, data: str | None, expected: Any) -> None:
    model = write(tmp_path, data)
    with SimulatedServer(model, model, play=True) as server:
        assert controllers(server) == {"lever": expected, "copy1_lever": expected}


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        ("lqr", "'lqr' is not a controller; the controllers are pd, passthrough"),
        ("pd,kp=stiff", "kp is a number from 0"),
    ],
)
def test_an_mjcf_that_names_none_says_what_there_is(tmp_path: Path, data: str, reason: str) -> None:
    with (
        pytest.raises(ModelError, match="lever: custom text 'urlab_controller'") as caught,
        SimulatedServer(write(tmp_path, data), play=True),
    ):
        pass
    assert reason in str(caught.value)


def level_of(folder: Path, **actors: str | None) -> Path:
    model = write(folder, "pd,kp=1")
    entries = [
        {"name": name, "kind": "articulation", "actor_id": name, "blueprint": "lever"}
        | ({} if text is None else {"controller": text})
        for name, text in actors.items()
    ]
    level = folder / "level.json"
    level.write_text(
        json.dumps(
            {
                "format": "urlab-level",
                "version": 1,
                "blueprints": {"lever": {"source": model.name}},
                "actors": [*entries, {"name": "manager", "kind": "manager"}],
            }
        )
    )
    return level


def test_a_level_names_controllers_by_actor_and_an_option_overrides_it(tmp_path: Path) -> None:
    level = level_of(tmp_path, one="pd,kp=7", two="passthrough", three=None)
    options = {"one": ControllerConfig(kp=11.0)}
    with SimulatedServer(level, play=True) as server:
        assert controllers(server) == {"one": ("pd", 7.0), "two": ("passthrough",), "three": ("pd", 1.0)}
    with SimulatedServer(level, play=True, controllers=options) as server:
        assert controllers(server) == {"one": ("pd", 11.0), "two": ("passthrough",), "three": ("pd", 1.0)}


def test_a_saved_level_keeps_its_controllers_wherever_it_is_moved(tmp_path: Path) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    saved = folder / "saved"
    with (
        SimulatedServer(level_of(folder, one="pd,kp=7"), saved_dir=saved) as server,
        URLabClient(**server.client_options()) as client,
    ):
        client.discover()
        client.scene.create_level("Bench", force_overwrite=True)
    moved = folder.rename(tmp_path / "there")
    with SimulatedServer(moved / "level.json", play=True) as server:
        assert controllers(server) == {"one": ("pd", 7.0)}


@pytest.mark.parametrize("text", ["lqr", "pd,ki=1"])
def test_a_level_with_no_such_controller_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ModelError, match=r"actor 0 \('one'\)"), SimulatedServer(level_of(tmp_path, one=text)):
        pass


def test_a_misspelt_name_is_refused_where_play_starts_with_the_server(tmp_path: Path) -> None:
    model = write(tmp_path, None)
    options = {"levr": ControllerConfig()}
    with (
        pytest.raises(ModelError, match="'levr', but the articulations are lever"),
        SimulatedServer(model, play=True, controllers=options),
    ):
        pass
    with (
        pytest.raises(ModelError, match="'lever/eye', but the cameras are none"),
        SimulatedServer(model, play=True, camera_modes={"lever/eye": "depth"}),
    ):
        pass
    with SimulatedServer(model, controllers=options) as server, URLabClient(**server.client_options()) as client:
        client.discover()
        blueprint = client.scene.import_xml(str(model))
        client.scene.spawn_actor(blueprint, actor_id="levr")
        client.sim.start()
        assert isinstance(client.articulations_by_id["levr"].controller, URLabPDController)


def test_a_kind_given_as_text_is_that_kind(tmp_path: Path) -> None:
    text: Any = "pd"
    with SimulatedServer(write(tmp_path, None), play=True, controllers={"*": ControllerConfig(text)}) as server:
        assert controllers(server) == {"lever": ("pd", 100.0)}
    wrong: Any = "lqr"
    with pytest.raises(ValueError, match="lqr"):
        ControllerConfig(wrong)
