"""Randomised episodes: the same numbers from servers and in a batch, and what noise, delays and pushes do."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import urlab_client
from urlab_client.cli import main
from urlab_client.integrations.gym import Reach, URLabBatchEnv, URLabEnv, URLabVectorEnv, Walk, batch
from urlab_client.integrations.record import read_run, record
from urlab_client.randomise import (
    CameraLatency,
    Delay,
    Noise,
    Push,
    Randomisation,
    UnsupportedRandomisation,
    Vary,
)
from urlab_client.server import ControllerConfig, SimulatedServer

EVERYTHING = Randomisation(
    vary=(
        Vary(what="friction", on="quadruped/*", scale=(0.5, 1.5)),
        Vary(what="mass", on="quadruped/trunk", scale=(0.8, 1.2)),
        Vary(what="inertia", scale=(0.9, 1.1)),
        Vary(what="centre_of_mass", on="quadruped/trunk", add=(-0.02, 0.02)),
        Vary(what="armature", add=(0.0, 0.01)),
        Vary(what="damping", scale=(1.0, 2.0), together=True),
        Vary(what="friction_loss", add=(0.0, 0.1)),
        Vary(what="kp", scale=(0.8, 1.2)),
        Vary(what="kv", scale=(0.5, 2.0), distribution="log-uniform"),
        Vary(what="strength", scale=(0.8, 1.0)),
        Vary(what="gravity", add=((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))),
        Vary(what="position", on="quadruped/*", add=(-0.1, 0.1)),
        Vary(what="base_position", add=((-1.0, -1.0, 0.0), (1.0, 1.0, 0.05))),
        Vary(what="base_yaw", add=(-3.0, 3.0)),
    ),
    push=(Push(body="quadruped/trunk", force=(-40.0, 40.0), every=(1, 3), lasts=2),),
    noise=(Noise(field="qpos", std=0.01, bias=0.02), Noise(field="task", uniform=0.1)),
    delay=Delay(observation=(0, 2), action=(0, 2), drop=0.2),
)

BETA: Any = {"dialect": "beta"}
PLUGIN: Any = {**BETA, "actor_names": "plugin"}
"""Options of a server whose compiled names begin otherwise than its robots are called."""


class FreeWalk(Walk):
    """Starts where it is put, so that what varies of the start stays; the robot's own fields are observed, too."""

    articulations: ClassVar[Any] = None

    def reset(self, rng: np.random.Generator, start: Any) -> None:
        start.goal["command"] = rng.uniform(self.LOW, self.HIGH)


def where(server: SimulatedServer) -> str:
    return f"{server.address}:{server.step_port}"


@pytest.mark.parametrize("naming", [{}, PLUGIN], ids=["model", "plugin"])
def test_servers_batches_and_single_environments_vary_bit_for_bit_alike(
    made: list[Any], naming: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pd = {"quadruped": ControllerConfig(kp=60.0, kv=2.0)}
    options: Any = {"play": True, "controllers": pd, **naming}
    server = SimulatedServer("quadruped", **options, randomise=EVERYTHING)
    plain = SimulatedServer("quadruped", **options)
    with server, plain, SimulatedServer("quadruped", **options, randomise=EVERYTHING) as second:
        copies = URLabBatchEnv(where(server), 2, task=FreeWalk(), max_episode_steps=5)
        wire = URLabVectorEnv([where(server), where(second)], task=FreeWalk(), max_episode_steps=5)
        monkeypatch.setattr(batch, "batch_class", lambda: None)  # as with releases before mujoco.batch
        asked = {"randomise": EVERYTHING, "max_episode_steps": 5}
        older = URLabBatchEnv(where(plain), 2, task=FreeWalk(), **asked)
        made += [wire, copies, older]
        envs: list[Any] = [wire, copies, older]
        starts = [env.reset(seed=3) for env in envs]
        rng = np.random.default_rng(0)
        actions = [rng.uniform(-0.5, 0.5, wire.action_space.shape).astype(np.float32) for _ in range(8)]
        rollouts = [[env.step(action) for action in actions] for env in envs]
        for (start, infos), rollout in zip(starts[1:], rollouts[1:], strict=True):
            assert np.array_equal(start, starts[0][0])
            assert np.array_equal(infos["episode_seed"], starts[0][1]["episode_seed"])
            for ours, theirs in zip(rollouts[0], rollout, strict=True):
                assert all(np.array_equal(a, b) for a, b in zip(ours[:4], theirs[:4], strict=True))
        assert [env.draws(1) for env in envs[1:]] == [wire.draws(1)] * 2
        assert wire.draws(0) != wire.draws(1)
        wire.close()
        single = URLabEnv.connect(where(server), task=FreeWalk(), max_episode_steps=5)
        made.append(single)
        assert single.randomise == EVERYTHING, "the server says what it varies"
        assert np.array_equal(single.reset(seed=3)[0], starts[0][0][0])
        ours: Any = ()
        for action, (seen, rewards, *_) in zip(actions[:5], rollouts[0], strict=False):
            ours = single.step(action[0])
            assert np.array_equal(ours[0], seen[0])
            assert ours[1] == rewards[0]
        assert ours[-1]["episode_seed"] == starts[0][1]["episode_seed"][0]
        with pytest.raises(UnsupportedRandomisation, match="no op of its protocol changes friction, mass") as refused:
            URLabEnv.connect(where(plain), randomise=EVERYTHING)
        settable = {"gravity", "position", "base_position", "base_yaw", "kp", "kv"}
        assert set(refused.value.quantities) == {vary.what for vary in EVERYTHING.vary} - settable
        assert str(pickle.loads(pickle.dumps(refused.value))) == str(refused.value)
        with pytest.raises(urlab_client.URLabError, match="varies its scene differently"):
            URLabEnv.connect(where(second), randomise=Randomisation())


def declared_while(client: urlab_client.URLabClient, path: Path) -> Randomisation | None:
    """Return what a recording that is made now says about what varies."""
    with record(client, path, pose_hz=0):
        pass
    said = read_run(path).summary().about.get("randomise")
    return None if said is None else Randomisation.from_json(said)


@pytest.mark.parametrize("naming", [{}, BETA, PLUGIN], ids=["alpha", "beta", "plugin"])
def test_a_server_that_varies_nothing_itself_varies_what_its_ops_reach(
    made: list[Any], naming: Any, tmp_path: Path
) -> None:
    settable = {"gravity", "position", "base_position", "base_yaw", "kp", "kv"}
    declared = Randomisation(vary=tuple(vary for vary in EVERYTHING.vary if vary.what in settable))
    pd = {"quadruped": ControllerConfig(kp=60.0, kv=2.0)}
    options = {"randomise": declared, "max_episode_steps": 5, "reset_noise": 0.05}
    with SimulatedServer("quadruped", play=True, controllers=pd, **naming) as server:
        copies = URLabBatchEnv(where(server), 1, task=FreeWalk(), **options)
        with urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client:
            client.discover()
            robot = client.articulations["quadruped"]
            before = dict(robot.controller.kp)
            gravity = client.runtime.set_sim_options().gravity
            env = URLabEnv(client, task=FreeWalk(), **options)
            made += [copies, env]
            drawn: list[Any] = []
            with record(client, tmp_path / "run.mcap", pose_hz=0):
                for seed in (3, 4):
                    env.reset(seed=seed)
                    env.step(np.zeros(12, dtype=np.float32))
                    drawn.append(env.draws())
                client.reset(seed=5)  # of somebody else: nothing is drawn for it
            recorded = read_run(tmp_path / "run.mcap").summary()
            assert Randomisation.from_json(recorded.about["randomise"]) == declared
            assert [told.seed for told in recorded.varied] == [each["seed"] for each in drawn]
            for told, expected in zip(recorded.varied, drawn, strict=True):
                assert [quantity.what for quantity in told.varied] == [vary.what for vary in declared.vary]
                for quantity, one in zip(told.varied, expected["varied"], strict=True):
                    rows = {name: row if isinstance(row, list) else [row] for name, row in one["drawn"].items()}
                    assert quantity.drawn == rows
            for seed in (3, 4):
                ours, (theirs, infos) = env.reset(seed=seed), copies.reset(seed=seed)
                assert ours[1]["episode_seed"] == infos["episode_seed"][0]
                assert env.draws() == copies.draws(0)
                assert np.allclose(ours[0], theirs[0], rtol=0, atol=1e-6)
                action = np.full(12, 0.3, dtype=np.float32)
                for _ in range(3):
                    ours, theirs = env.step(action), copies.step(action[None])[0]
                assert np.allclose(ours[0], theirs[0], rtol=0, atol=1e-3)
            assert robot.controller.kp != before
            assert client.runtime.set_sim_options().gravity != gravity
            less = Randomisation(vary=declared.vary[:1])
            unused = URLabEnv(client, task=FreeWalk(), **{**options, "randomise": less})
            assert declared_while(client, tmp_path / "unused.mcap") == less, "the newest environment"
            env.close()
            assert robot.controller.kp == before
            assert client.runtime.set_sim_options().gravity == gravity
            unused.close()
            assert declared_while(client, tmp_path / "closed.mcap") is None

            wire = URLabVectorEnv([where(server)], task=FreeWalk(), **options)
            made.append(wire)
            first = wire.reset(seed=3)[0]

            async def lose() -> None:
                await wire._sessions[0].reopen()

            wire._portal.call(lose)  # as after a failure: gravity and gains are those of an episode
            assert np.array_equal(wire.reset(seed=3)[0], first)
            wire.close()
            client.discover()
            assert client.articulations["quadruped"].controller.kp == before
            assert client.runtime.set_sim_options().gravity == gravity
        servo = Randomisation(vary=(Vary(what="kp", scale=(0.5, 2.0)),))
        with SimulatedServer("arm", play=True) as arm, pytest.raises(UnsupportedRandomisation, match="changes kp"):
            URLabEnv.connect(where(arm), randomise=servo)


def fallen(client: urlab_client.URLabClient, seed: int | None) -> float:
    """Return how far a ball falls in 50 steps."""
    start = client.reset(seed=seed).per_articulation["ball"].qpos[2]
    return start - client.step(50).per_articulation["ball"].qpos[2]


def test_a_server_varies_by_the_seed_of_a_reset_and_tells_of_the_scene_without() -> None:
    declared = Randomisation(
        vary=(
            Vary(what="gravity", set=((0.0, 0.0, -9.0), (0.0, 0.0, -1.0))),
            Vary(what="mass", scale=(1.5, 2.0)),
            Vary(what="base_position", set=((0.0, 0.0, 2.0), (0.0, 0.0, 3.0))),
        )
    )
    with (
        SimulatedServer("ball", play=True, randomise=declared) as server,
        urlab_client.URLabClient(**server.client_options(), step_mode="direct") as client,
    ):
        client.discover()
        model: Any = client.model
        nominal = {
            name: np.array(getattr(model, name)) for name in ("body_mass", "body_subtreemass", "body_invweight0")
        }
        one, two, three = fallen(client, 1), fallen(client, None), fallen(client, None)
        assert len({one, two, three}) == 3
        assert [fallen(client, seed) for seed in (1, None, None)] == [one, two, three], "what follows from the seed"
        assert client.reset_seed is None
        assert 0.004 < fallen(client, -5) < 0.046
        client.discover()
        for name, values in nominal.items():
            assert np.array_equal(getattr(client.model, name), values)
        assert client.model is not None
        assert client.model.opt.gravity[2] == -9.81
        server.restore()
        client.discover()
        assert client.step(50).per_articulation["ball"].qpos[2] < 0.9, "from where the model has it, and falling freely"
        for name, values in nominal.items():
            assert np.array_equal(getattr(client.model, name), values), (
                "and varied from there, not from the last episode"
            )


def test_late_lost_and_noisy_samples_are_seen_and_rewards_are_judged_without(made: list[Any]) -> None:
    class Still(Reach):
        truths: ClassVar[list[Any]] = []

        def reward(self, states: Any, actions: Any) -> Any:
            self.truths.append(states.positions("arm"))
            return super().reward(states, actions)

    with SimulatedServer("arm", play=True) as server:

        def rollout(declared: Randomisation | None, n: int = 8) -> tuple[list[Any], Any]:
            Still.truths = []
            env = URLabBatchEnv(where(server), 1, task=Still(), observations=["qpos"], randomise=declared)
            made.append(env)
            seen = [env.reset(seed=5)[0][0]]
            seen += [env.step(np.full((1, 7), 0.1 * k, dtype=np.float32))[0][0] for k in range(n)]
            return seen, [truth[0] for truth in Still.truths]

        clean, truth = rollout(Randomisation())
        late, same = rollout(Randomisation(delay=Delay(observation=2)))
        assert np.array_equal(same, truth)
        for k, observation in enumerate(late):
            assert np.array_equal(observation, clean[max(0, k - 2)])
        _, slow = rollout(Randomisation(delay=Delay(action=1)))
        held = URLabBatchEnv(where(server), 1, task=Reach(), observations=["qpos"], randomise=Randomisation())
        made.append(held)
        held.reset(seed=5)
        zero, first = np.zeros((1, 7), dtype=np.float32), np.full((1, 7), 0.1, dtype=np.float32)
        held.step(zero)
        held.step(zero)
        assert np.array_equal(held.step(first)[0][0, :8], slow[2]), "the second action came one later"
        lossy, _ = rollout(Randomisation(delay=Delay(drop=0.5)))
        assert np.array_equal(lossy[0], clean[0])
        kept = [next(k for k, old in enumerate(clean) if np.array_equal(old, seen)) for seen in lossy]
        assert kept == sorted(kept)
        assert 1 < len(set(kept)) < len(kept)
        biased, _ = rollout(Randomisation(noise=(Noise(field="qpos", bias=0.1),)))
        biases = np.array(biased) - np.array(clean)
        np.testing.assert_allclose(biases, biases[:1].repeat(len(biases), 0), atol=1e-15)
        assert 0 < np.abs(biases[0, :8]).min() < np.abs(biases[0, :8]).max() <= 0.1
        assert not biases[:, 8:].any(), "what the task adds has none"
        noisy, judged = rollout(Randomisation(noise=(Noise(field="qpos", std=0.01, articulation="a*"),)), 40)
        assert np.array_equal(judged[:8], truth)
        assert 0.007 < np.std(np.array(noisy)[1:, :8] - np.array(judged)) < 0.013
        for declared, reason in (
            (Randomisation(noise=(Noise(field="qvel", std=1.0),)), "noise on qvel, which is not observed"),
            (
                Randomisation(noise=(Noise(field="qpos", articulation="leg"),)),
                "no observed articulation",
            ),
            (Randomisation(push=(Push(body="arm/nose", force=(0, 1), every=(1, 1)),)), "no body 'arm/nose'"),
            (Randomisation(vary=(Vary(what="mass", on="arm/nose", scale=(1, 2)),)), "no body with a mass is called"),
        ):
            with pytest.raises(KeyError if declared.push else ValueError, match=reason):
                URLabBatchEnv(where(server), 1, task=Reach(), observations=["qpos"], randomise=declared)
    noisy_joints = Randomisation(noise=(Noise(field="qpos", std=1.0),))
    with pytest.raises(ValueError, match=r"not observed; the observed fields are task$"):  # Walk shows nothing else
        URLabBatchEnv(Walk.scene_address, 1, task=Walk(), randomise=noisy_joints)


def test_an_episode_ends_with_what_was_seen_and_leaves_nothing_to_the_next(made: list[Any]) -> None:
    disturbed = Randomisation(
        noise=(Noise(field="qpos", std=0.01, bias=0.05),), delay=Delay(observation=(1, 2), action=2, drop=0.2)
    )
    with SimulatedServer("arm", play=True) as server:

        def env_of(mode: AutoresetMode) -> URLabBatchEnv:
            options: Any = {"observations": ["qpos"], "randomise": disturbed, "max_episode_steps": 3}
            env = URLabBatchEnv(where(server), 2, autoreset_mode=mode, **options)
            made.append(env)
            return env

        def episode(env: URLabBatchEnv) -> list[Any]:
            seen = [env.reset(seed=5)[0]]
            actions = (np.full(env.action_space.shape, 0.3 * k, dtype=np.float32) for k in (1, 2, 3))
            return [*seen, *(env.step(action) for action in actions)]

        disabled, same_step = env_of(AutoresetMode.DISABLED), env_of(AutoresetMode.SAME_STEP)
        first, second = episode(disabled), episode(disabled)
        assert np.array_equal(first[0], second[0])
        for ours, theirs in zip(first[1:], second[1:], strict=True):
            assert np.array_equal(ours[0], theirs[0]), "no action or picture of the episode before"
        ended = episode(same_step)[-1]
        assert ended[3].all()
        for final, last in zip(ended[4]["final_obs"], first[-1][0], strict=True):
            assert np.array_equal(final, last), "the last observation as the agent sees it, noise and delay included"


def test_what_varied_is_recorded_and_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], serving: Callable[..., str]
) -> None:
    file = tmp_path / "arm.toml"
    file.write_text(
        '[[vary]]\nwhat = "mass"\non = "arm/hand"\nscale = [0.5, 2.0]\n[[noise]]\nfield = "qpos"\nbias = 1.0\n'
    )
    env = URLabEnv.connect(serving("arm", randomise=file), task=Reach())
    drawn: list[Any] = []
    with record(env.client, tmp_path / "run.mcap"):
        for seed in (1, 2):
            env.reset(seed=seed)
            drawn.append(env.draws())
            for _ in range(3):
                env.step(env.action_space.sample())
    assert env.randomise == Randomisation.load(file)
    env.close()
    summary = read_run(tmp_path / "run.mcap").summary()
    assert Randomisation.from_json(summary.about["randomise"]) == env.randomise
    assert [episode.episode for episode in summary.varied] == [0, 1]
    for told, (expected,) in zip(summary.varied, [each["varied"] for each in drawn], strict=True):
        (quantity,) = told.varied
        assert {name: row[0] for name, row in quantity.drawn.items()} == expected["drawn"]
        assert (quantity.what, quantity.by) == ("mass", "scale")
    assert [told.seed for told in summary.varied] == [each["seed"] for each in drawn]
    assert main(["info", str(tmp_path / "run.mcap")]) == 0
    factors = [told.varied[0].drawn["arm_hand"][0] for told in summary.varied]
    assert f"varied: mass, scale {min(factors):.4g} to {max(factors):.4g} on 1 element" in capsys.readouterr().out


@pytest.mark.opengl
def test_pictures_vary_and_come_late_by_the_simulations_clock(made: list[Any]) -> None:
    look = Randomisation(
        vary=(
            Vary(what="colour", on="arm/*", set=((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))),
            Vary(what="camera_position", on="arm/overview", add=(-0.1, 0.1)),
        ),
        camera=(CameraLatency(camera="arm/overview", delay_s=0.04),),
    )
    options: Any = {"observations": ["qpos"], "space_mode": "dict", "cameras": ["arm/overview"], "n_substeps": 10}
    with SimulatedServer("arm", play=True, randomise=look, dialect="beta", camera_size=(64, 48)) as server:
        batch = URLabBatchEnv(where(server), 1, **options)
        env = URLabEnv.connect(where(server), **options)
        made += [env, batch]

        def pictures(seed: int) -> list[Any]:
            seen = [env.reset(seed=seed)[0]]
            seen += [env.step({"arm": np.full(7, 0.5, dtype=np.float32)})[0] for _ in range(5)]
            return [each["cameras"]["arm/overview"] for each in seen]

        one, again, other = pictures(1), pictures(1), pictures(2)
        assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))
        assert not np.array_equal(one[0], other[0])
        assert np.array_equal(one[0], one[2]), "two actions of 0.02 s late"
        assert not np.array_equal(one[2], one[5])
        seen = [batch.reset(seed=1)[0]]
        seen += [batch.step({"arm": np.full((1, 7), 0.5, dtype=np.float32)})[0] for _ in range(5)]
        ours = [each["cameras"]["arm/overview"][0] for each in seen]
        assert all(np.array_equal(a, b) for a, b in zip(one, ours, strict=True)), "a batch is as late"
