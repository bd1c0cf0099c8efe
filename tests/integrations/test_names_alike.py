"""Tasks come to the same bits whatever a server calls its robots, on either dialect, over the wire and in a batch.

Robots are written by their actor id, `arm`. It is the robot's key and begins its compiled names (alpha), it is the key,
but compiled names begin with `arm_C_0_` (beta), or both are `arm_C_0` (alpha with names as the plugin assigns them).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from urlab_client.integrations.gym import (
    Actions,
    FixedReach,
    Push,
    Reach,
    ResetNoise,
    Run,
    Start,
    States,
    Task,
    URLabBatchEnv,
    URLabEnv,
    Walk,
)
from urlab_client.integrations.record import read_run, record, transitions_of
from urlab_client.randomise import Delay, Noise, Randomisation, Vary
from urlab_client.randomise import Push as Shove
from urlab_client.server import ControllerConfig, SimulatedServer

NAMINGS: list[tuple[Any, Any]] = [(dialect, naming) for dialect in ("alpha", "beta") for naming in ("model", "plugin")]
PD = {"quadruped": ControllerConfig(kp=64.0, kv=2.0)}

VARIED = Randomisation(
    vary=(
        Vary(what="mass", on="block/*", scale=(0.5, 2.0)),
        Vary(what="damping", on="arm/elbow", scale=(0.5, 2.0)),
        Vary(what="friction", on="arm_*", scale=(0.5, 1.5)),
        Vary(what="position", on="arm/wrist*", add=(-0.1, 0.1)),
        Vary(what="gravity", add=(-0.25, 0.25)),
    ),
    push=(
        Shove(body="block/block", force=(-2.0, 2.0), every=(1, 2), lasts=2),
        Shove(body="arm_forearm", force=(-20.0, 20.0), every=(1, 3), lasts=1),
    ),
    noise=(Noise(field="qpos", articulation="arm", std=0.01, bias=0.02),),
    delay=Delay(observation=(0, 1)),
)


class Own(Task):
    """Names robots and elements in each way that a task can."""

    scene_address: ClassVar[str] = "sim://arm?model=block&model=floor"
    observations: ClassVar[str | Sequence[str]] = "standard"
    articulations: ClassVar[Sequence[str] | None] = ("block", "arm")
    keyframe: ClassVar[str | None] = "arm/home"
    n_observed: ClassVar[int] = 4
    n_substeps: ClassVar[int] = 10

    def reset(self, rng: np.random.Generator, start: Start) -> None:
        start.noise(rng, "arm", ResetNoise(hinge=0.05))
        start.joint("arm_wrist_pitch", -1.0)
        start.place("block", [rng.uniform(0.4, 0.5), 0.0, 0.03])
        start.goal["target"] = rng.uniform(-1.0, 1.0, 3)

    def observe(self, states: States) -> Any:
        near = states.touching("block/block", "floor/floor")[:, None]
        return np.concatenate([states.body_position("arm/forearm"), near], axis=1)

    def reward(self, states: States, actions: Any) -> Any:
        effort = np.sum(self.scene.mapping.set_points(actions)["arm"] ** 2, axis=1)
        far = np.linalg.norm(states.site_position("grip") - states.body_position("block/block"), axis=1)
        return states.positions("block")[:, 0] + states.velocities("arm")[:, 1] - far - effort


TASKS: dict[str, tuple[type[Task], dict[str, Any], dict[str, Any]]] = {
    "reach": (Reach, {}, {}),
    "arm": (FixedReach, {}, {}),
    "push": (Push, {}, {}),
    "walk": (Walk, {"controllers": PD}, {"actions": {"quadruped": Actions(scale=0.25)}}),
    "quadruped": (Run, {}, {}),
    "own": (Own, {"randomise": VARIED}, {}),
}
MODELS = {"quadruped": ("quadruped",), "push": ("arm", "block", "floor"), "walk": ("quadruped",)}


def rollout(env: Any, *, batch: bool) -> list[Any]:
    """Return what an environment, or the only copy of a batch, shows and rewards."""
    rng = np.random.default_rng(2)
    seen: list[Any] = [env.reset(seed=[6] if batch else 6)[0]]
    for _ in range(6):
        action = rng.uniform(-0.5, 0.5, env.action_space.shape[-1]).astype(np.float32)
        seen += env.step(action[None] if batch else action)[:4]
    return [values[0] for values in seen] if batch else seen


@pytest.mark.parametrize("name", TASKS)
def test_a_task_comes_to_the_same_whatever_its_robots_are_called(name: str) -> None:
    kind, served, options = TASKS[name]
    models = MODELS.get(name, ("arm", "block", "floor"))
    found: dict[str, list[Any]] = {}
    for dialect, naming in NAMINGS:
        with SimulatedServer(
            *models, play=True, mjcf_options=True, dialect=dialect, actor_names=naming, **served
        ) as server:
            address = f"{server.address}:{server.step_port}"
            with closing(URLabEnv.connect(address, task=kind(), **options)) as wire:
                found[f"{dialect}, {naming}"] = rollout(wire, batch=False)
            with closing(URLabBatchEnv(address, 1, task=kind(), **options)) as batch:
                found[f"{dialect}, {naming}, batch"] = rollout(batch, batch=True)
    expected = found["alpha, model"]
    assert len(set(expected[2::4])) == 6, "each state is rewarded otherwise"
    for where, seen in found.items():
        # What a controller makes of its targets is rounded to single precision in the alpha.
        same = partial(np.allclose, atol=1e-5) if kind is Walk and "beta" in where else np.array_equal
        assert all(same(ours, theirs) for ours, theirs in zip(seen, expected, strict=True)), where
    beta = [seen for where, seen in found.items() if "beta" in where]
    assert all(np.array_equal(*pair) for seen in beta for pair in zip(seen, beta[0], strict=True))


def test_dictionaries_are_the_same_whatever_robots_are_called() -> None:
    found: dict[str, Any] = {}
    for dialect, naming in NAMINGS:
        with SimulatedServer("quadruped", "arm", play=True, dialect=dialect, actor_names=naming) as server:
            address = f"{server.address}:{server.step_port}"
            options: dict[str, Any] = {"space_mode": "dict", "observations": ["qvel", "qpos"]}
            with closing(URLabEnv.connect(address, **options)) as wire:
                spaces: Any = wire.observation_space, wire.action_space
                start, _ = wire.reset(seed=1)
                action = {name: np.full(space.shape, 0.1, np.float32) for name, space in spaces[1].items()}
                then = wire.step(action)[0]
                own = {wire.articulations.key(name): part for name, part in action.items()}
                assert np.array_equal(wire.mapping.flat(own), wire.mapping.flat(action))
                with pytest.raises(ValueError, match=r"one entry for each of quadruped, arm, not \['arm'\]"):
                    wire.step({"arm": action["arm"]})
            with closing(URLabBatchEnv(address, 1, **options)) as batch:
                assert (batch.single_observation_space, batch.single_action_space) == spaces
                assert [*batch.reset(seed=[1])[0]] == [*start]
            where = f"{dialect}, {naming}"
            found[where] = [*map(repr, spaces)], [np.concatenate([*fields.values()]) for fields in then.values()]
            assert [*spaces[0], *spaces[1], *start, *then] == ["quadruped", "arm"] * 4, "in the order of the robots"
            assert [*spaces[0]["arm"], *start["arm"]] == ["qvel", "qpos"] * 2, "in the order of the request"
    expected = found["alpha, model"]
    for where, (spaces, then) in found.items():
        assert spaces == expected[0], where
        assert all(np.array_equal(*pair) for pair in zip(then, expected[1], strict=True)), where


@pytest.mark.opengl
def test_recordings_are_the_same_whatever_robots_are_called(tmp_path: Path) -> None:
    found: dict[str, dict[str, Any]] = {}
    late = Randomisation(delay=Delay(action=(1, 1)))
    for dialect, naming in NAMINGS:
        where, path = f"{dialect}, {naming}", tmp_path / f"{dialect}-{naming}.mcap"
        with SimulatedServer("block", "arm", play=True, dialect=dialect, actor_names=naming) as server:
            address = f"{server.address}:{server.step_port}"
            with (
                closing(URLabEnv.connect(address, randomise=late)) as env,
                record(env.client, path, cameras=["arm/wrist"]),
            ):
                env.reset(seed=1)
                for _ in range(3):
                    env.step(np.full(env.action_space.shape, 0.1, np.float32))
        run = read_run(path)
        (topic,) = run.cameras()
        assert {*run.positions()} == {"block", "arm"}, where
        assert topic == "arm/wrist", where
        assert run.picture_at("arm/wrist", 1.0) is not None
        state = run.state_at(1.0)
        assert state is not None
        assert {*state.articulations} == {"block", "arm"}
        found[where] = {**run.table().arrays(), **transitions_of(run).arrays()}
        del found[where]["wall_ns"]
    expected = found["alpha, model"]
    assert {"arm/qpos", "arm/action", "arm/applied", "block/qvel", "task/chosen/arm"} <= expected.keys()
    for where, arrays in found.items():
        assert arrays.keys() == expected.keys(), where
        for name, values in arrays.items():
            assert np.array_equal(values, expected[name], equal_nan=True), (where, name)
