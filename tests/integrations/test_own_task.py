"""A task of one's own, under an id or as `module:Class`, in Gymnasium and in every command that takes a task."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from urlab_client.cli import main
from urlab_client.integrations.gym import TASKS, Reach, URLabBatchEnv, URLabVectorEnv, register_task, task_named

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

SOURCE = '''
from urlab_client.integrations.gym import Reach


class Near(Reach):
    """Targets close to the hand; every state is a success."""

    max_episode_steps = 3

    def success(self, states):
        return super().success(states) | True


class Unrelated:
    pass
'''


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A module with a task in the current folder, from which `urlab` is started."""
    (tmp_path / "tasks_of_mine.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    yield "tasks_of_mine"
    import sys

    sys.modules.pop("tasks_of_mine", None)
    if str(tmp_path) in sys.path:
        sys.path.remove(str(tmp_path))


@pytest.fixture
def still(tmp_path: Path) -> Path:
    """A network that holds all set-points at 0."""
    helper, number = onnx.helper, onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [helper.make_node("MatMul", ["observation", "zeros"], ["action"])],
        "still",
        [helper.make_tensor_value_info("observation", number, ["batch", 22])],
        [helper.make_tensor_value_info("action", number, ["batch", 7])],
        [onnx.numpy_helper.from_array(np.zeros((22, 7), np.float32), "zeros")],
    )
    file = tmp_path / "still.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), file)
    return file


def test_one_line_makes_single_vector_and_batch_environments(made: list[Any]) -> None:
    class Short(Reach):
        max_episode_steps = 2

    register_task("mine/Short-v0", Short)
    try:
        register_task("mine/Short-v0", Short)  # again, as when a notebook's cell runs twice
        single = gymnasium.make("mine/Short-v0", disable_env_checker=True)
        servers = gymnasium.make_vec("mine/Short-v0", num_envs=1)
        batch = gymnasium.make_vec("mine/Short-v0", num_envs=1, backend="batch")
        made += [single, servers, batch]
        assert (type(servers), type(batch)) == (URLabVectorEnv, URLabBatchEnv)
        first = single.reset(seed=2)[0]
        for env in (servers, batch):
            assert np.array_equal(env.reset(seed=2)[0][0], first)
        action = np.full(7, 0.1, dtype=np.float32)
        for _ in range(2):
            ours = single.step(action)
            theirs = [env.step(action[None]) for env in (servers, batch)]
        assert [bool(each[3]) for each in (ours, *theirs)] == [True] * 3
        assert ours[1] == theirs[0][1][0] == theirs[1][1][0]
        with pytest.raises(ValueError, match="'mine/Short-v0' already names Short"):
            register_task("mine/Short-v0", Reach)
        with pytest.raises(ValueError, match="dict must be a subclass of Task"):
            register_task("mine/Dict-v0", dict)  # type: ignore[arg-type]
    finally:
        del TASKS["mine/Short-v0"], gymnasium.registry["mine/Short-v0"]


def test_commands_take_a_class_of_the_current_folder(
    module: str, still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = ["--task", f"{module}:Near"]
    assert main(["evaluate", str(still), *task, "--episodes=2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["success_rate"]["value"] == 1.0
    assert main(["run-policy", str(still), *task, "--seconds=0.1", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["actions"], said["success"], said["terminated"]) == (5, True, False), "as long as --seconds says"
    recording = tmp_path / "near.mcap"
    assert main(["run-policy", str(still), *task, "--seconds=0.1", "--record", str(recording)]) == 0
    assert "still.onnx in tasks_of_mine:Near" in capsys.readouterr().out
    assert recording.stat().st_size > 0
    for name, problem in (
        (f"{module}:Far", "'Far' in module 'tasks_of_mine' is not a subclass of Task"),
        (f"{module}:Unrelated", "'Unrelated' in module 'tasks_of_mine' is not a subclass of Task"),
        ("no_such:Near", "the module of the task 'no_such:Near' cannot be imported"),
        ("urlab/Rech-v0", "'urlab/Rech-v0' is not a task. Did you mean 'urlab/Reach-v0'"),
    ):
        for command in (["evaluate", str(still)], ["run-policy", str(still)], ["teleop"]):
            assert main([*command, "--task", name]) == 2
            assert f"--task: {problem}" in capsys.readouterr().err
    assert main(["run-policy", str(still), *task, "--robot", "arm"]) == 2
    assert "--robot cannot be combined with --task" in capsys.readouterr().err
    assert task_named(f"{module}:Near").__name__ == "Near"
    walk = (Path(__file__).parents[2] / "examples/policies/walk.toml").read_text()
    still.with_suffix(".toml").write_text(f'task = "{module}:Near"\n{walk}')
    for command in ("evaluate", "run-policy"):
        assert main([command, str(still)]) == 2, "a file that somebody sends runs no module"
        assert f"say --task {module}:Near to run that module's code" in capsys.readouterr().err
