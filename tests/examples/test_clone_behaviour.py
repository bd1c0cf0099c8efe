"""From teleoperation to a policy, in the short form: fewer demonstrations, and a policy that is worse for it."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

from urlab_client.cli import main

EXAMPLE = Path(__file__).parents[2] / "examples" / "clone_behaviour.py"


@pytest.mark.long
def test_recorded_episodes_become_a_policy_that_the_commands_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = importlib.util.spec_from_file_location("clone_behaviour", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    found = example.main([f"--output={tmp_path}", "--episodes=20", "--evaluated=12"])
    assert found["demonstrations"] == {"episodes": 20, "successes": 20}
    assert found["pairs"] == 20 * 100
    assert found["policy"]["value"] >= 0.5
    capsys.readouterr()

    network = str(tmp_path / "reach.onnx")
    assert main(["evaluate", network, "--task", "urlab/Reach-v0", "--episodes", "6", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["success_rate"]["value"] >= 0.5
    assert main(["run-policy", network, "--goal", "0.35", "0.1", "0.4", "--seconds", "2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["policy"]["goal_error"] < 0.05
    assert main(["run-policy", network, "--goal", "0.35", "0.1"]) == 2
    assert "a goal must be from [0.25, -0.25, 0.25] to [0.45, 0.25, 0.5], not [0.35, 0.1]" in capsys.readouterr().err
