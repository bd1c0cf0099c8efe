"""Rollouts on a Ray cluster of three nodes in this machine, with workers and nodes that go away."""

from __future__ import annotations

import contextlib
import os
import secrets
import select
import tempfile
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio.to_thread
import numpy as np
import pytest

from urlab_client import URLabClient
from urlab_client.errors import LeaseBusy
from urlab_client.server import SimulatedServer

pytestmark = pytest.mark.ray

STEPS = 8

# What policies use is defined inside functions: that is sent to the workers by value, and they cannot import tests.


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without processors, for the driver, and two nodes with one each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))  # else Ray leaves one in the home folder
    os.environ["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"
    import ray
    from ray.cluster_utils import Cluster

    store = 80 << 20
    with tempfile.TemporaryDirectory(prefix="r", dir="/tmp", ignore_cleanup_errors=True) as scratch:
        os.environ["RAY_TMPDIR"] = scratch  # short: sockets are in it
        cluster = Cluster(
            initialize_head=True,
            head_node_args={
                "num_cpus": 0,
                "object_store_memory": store,
                "include_dashboard": False,
            },
        )
        try:
            for _ in range(2):
                cluster.add_node(num_cpus=1, object_store_memory=store)
            ray.init(address=cluster.address, log_to_driver=False)
            cluster.wait_for_nodes()
            yield cluster
        finally:
            ray.shutdown()
            cluster.shutdown()


def noisy() -> Any:
    def policy(observation: Any, rng: np.random.Generator) -> Any:
        return rng.normal(scale=0.3, size=7)

    return policy


OPTIONS: dict[str, Any] = {
    "max_episode_steps": STEPS,
    "seed": 5,
    "env_options": {"n_substeps": 5, "reset_noise": 0.05},
}


def same(a: Any, b: Any) -> None:
    assert (a.id, a.seed, a.scene) == (b.id, b.seed, b.scene)
    for name in ("observations", "actions", "rewards"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


@pytest.fixture(scope="module")
def expected(cluster: Any) -> dict[int, Any]:
    """What a run without failures gives, with one worker."""
    from urlab_client.cluster import rollouts

    episodes = list(rollouts(noisy(), "sim://arm", 6, n_workers=1, **OPTIONS))
    assert [episode.id for episode in episodes] == list(range(6))
    return {episode.id: episode for episode in episodes}


def test_episodes_are_whole_and_differ_by_seed(expected: dict[int, Any]) -> None:
    assert len({episode.seed for episode in expected.values()}) == 6
    assert len({episode.observations.tobytes() for episode in expected.values()}) == 6
    for episode in expected.values():
        assert (len(episode.observations), len(episode.actions), len(episode.rewards)) == (STEPS + 1, STEPS, STEPS)
        assert (episode.attempt, episode.terminated, episode.truncated) == (1, False, True)
        assert episode.scene == episode.address == "sim://arm"
        assert episode.sim_time > 0 < episode.setup <= episode.duration


def notes_children(folder: Path) -> Any:
    """Return a policy that notes the children's process ids, in a file for each process, and waits for the other one.

    Otherwise a worker that is quick could have done everything before the other has begun.
    """
    inner, name = noisy(), str(folder)

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        children = [file.read_text() for file in Path("/proc/self/task").glob("*/children")]
        Path(name, str(os.getpid())).write_text("".join(children))
        deadline = time.monotonic() + 60
        while len(os.listdir(name)) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        return inner(observation, rng)

    return policy


def test_a_run_goes_on_with_what_is_missing_on_workers_that_stay_up(expected: dict[int, Any], tmp_path: Path) -> None:
    from urlab_client import URLabError
    from urlab_client.cluster import WorkerPool, load_episodes, missing_ids, rollouts, save_episode

    saved, notes = tmp_path / "saved", tmp_path / "notes"
    notes.mkdir()
    run = (notes_children(notes), "sim://arm", 6)
    servers = list[dict[str, str]]()
    with WorkerPool(2) as workers:
        for ids in ([0, 4], missing_ids):
            missing = ids if isinstance(ids, list) else ids(saved, 6, seed=5)
            for episode in rollouts(*run, ids=missing, workers=workers, **OPTIONS):
                save_episode(episode, saved)
            servers.append({path.name: path.read_text() for path in notes.iterdir()})
        assert missing == [1, 2, 3, 5]
        assert servers[0] == servers[1]  # the same processes, with the same servers
        assert workers.size == len(servers[0]) == 2

        dead = int(next(iter(servers[0])))
        os.kill(dead, 9)
        with rollouts(*run, workers=workers, **OPTIONS) as episodes:
            first = next(episodes)
            with pytest.raises(URLabError, match="Another run is using the worker pool"):
                next(rollouts(*run, workers=workers, **OPTIONS))
        assert first.attempt == 1
        assert first.pid != dead
    assert all(gone(path) for path in notes.iterdir())
    got = list(load_episodes(saved))
    assert [episode.id for episode in got] == list(range(6))
    for episode in got:
        same(episode, expected[episode.id])
    assert missing_ids(saved, 6, seed=5) == []
    with pytest.raises(ValueError, match=r"episode_000000\.npz does not belong to a run of 6 episodes with seed 4"):
        missing_ids(saved, 6, seed=4)
    (saved / "episode_000003.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"episode_000003\.npz does not contain an episode"):
        missing_ids(saved, 6, seed=5)


@pytest.mark.opengl
def test_dictionaries_and_pictures_come_back_as_they_were_seen(cluster: Any, tmp_path: Path) -> None:
    from urlab_client.cluster import load_episodes, rollouts, save_episode
    from urlab_client.integrations.gym import Reach

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        shape = observation["cameras"]["arm/wrist"].shape
        return {"arm": np.r_[observation["task"][:3] + observation["arm"]["qpos"][:3], shape, 0.0] / 1000}

    options = {"task": Reach(), "space_mode": "dict", "observations": ["qpos"], "cameras": ["arm/wrist"]}
    (episode,) = rollouts(policy, "sim://arm", 1, max_episode_steps=2, env_options=options)
    seen, actions = episode.observations, episode.actions["arm"]
    pictures = seen["cameras"]["arm/wrist"]
    assert pictures.dtype == np.uint8
    assert pictures.shape[0] == 3
    assert len(np.unique(pictures)) > 2
    assert actions.dtype == np.float32
    assert np.array_equal(actions[:, :3], np.float32((seen["task"][:, :3] + seen["arm"]["qpos"][:, :3])[:-1] / 1000))
    assert np.array_equal(actions[:, 3:6] * 1000, np.broadcast_to(pictures.shape[1:], (2, 3)))
    assert episode.success is False
    (back,) = load_episodes(save_episode(episode, tmp_path).parent)
    assert back.observations.keys() == seen.keys()
    assert np.array_equal(back.observations["cameras"]["arm/wrist"], pictures)
    assert np.array_equal(back.actions["arm"], actions)
    assert (back.id, back.duration, back.success) == (0, episode.duration, False)


def dies_once(marker: Path) -> Any:
    """Return a policy that kills its process in the middle of one episode, having noted the children's process ids."""
    inner, path = noisy(), str(marker)

    class Policy:
        steps = 0

        def __call__(self, observation: Any, rng: np.random.Generator) -> Any:
            self.steps += 1  # of this episode: each one gets a copy
            if self.steps == STEPS // 2:
                try:
                    handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
                except FileExistsError:
                    return inner(observation, rng)
                children = [file.read_text() for file in Path("/proc/self/task").glob("*/children")]
                os.write(handle, "".join(children).encode())
                os.kill(os.getpid(), 9)
            return inner(observation, rng)

    return Policy()


def gone(notes: Path) -> bool:
    """Wait for the end of the processes that a policy noted; there must be some."""
    pids = [int(pid) for pid in notes.read_text().split()]
    for pid in pids:
        try:
            handle = os.pidfd_open(pid)
        except ProcessLookupError:
            continue
        ended, _, _ = select.select([handle], [], [], 30)
        os.close(handle)
        if not ended:
            return False
    return bool(pids)


async def test_a_killed_worker_loses_and_doubles_no_episode(expected: dict[int, Any], tmp_path: Path) -> None:
    from urlab_client.cluster import rollouts

    got: dict[int, Any] = {}
    async for episode in rollouts(dies_once(tmp_path / "killed"), "sim://arm", 6, n_workers=2, **OPTIONS):
        assert episode.id not in got
        got[episode.id] = episode
    assert sorted(got) == list(range(6))
    assert sorted(episode.attempt for episode in got.values()) == [1, 1, 1, 1, 1, 2]
    for i, episode in got.items():
        same(episode, expected[i])
    assert gone(tmp_path / "killed")


def test_tasks_give_the_same_episodes_and_are_run_again_by_ray(expected: dict[int, Any], tmp_path: Path) -> None:
    import ray

    from urlab_client.cluster import run_episode

    task = ray.remote(run_episode).options(num_cpus=1, max_retries=1)
    policy = dies_once(tmp_path / "killed")
    got = ray.get([task.remote(policy, "sim://arm", i, **OPTIONS) for i in range(3)], timeout=90)
    for i, episode in enumerate(got):
        same(episode, expected[i])
    assert gone(tmp_path / "killed")


def ends_its_server_once(notes: Path) -> Any:
    """Return a policy that kills its server in the first attempt and notes the process id of each attempt's worker."""
    name = str(notes)

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        seen = Path(name).read_text().split() if Path(name).exists() else []
        if not seen:
            children = [file.read_text() for file in Path("/proc/self/task").glob("*/children")]
            for pid in "".join(children).split():
                os.kill(int(pid), 9)
        if len(seen) < 2:
            Path(name).write_text(" ".join([*seen, str(os.getpid())]))
        return np.zeros(7)

    return policy


def test_an_episode_whose_server_died_runs_again_on_a_new_one(cluster: Any, tmp_path: Path) -> None:
    from urlab_client.cluster import rollouts

    policy = ends_its_server_once(tmp_path / "workers")
    (episode,) = rollouts(policy, "sim://arm", 1, n_workers=1, retries=1, **OPTIONS)
    assert episode.attempt == 2
    first, second = (tmp_path / "workers").read_text().split()
    assert first == second, "the worker itself stays"


def test_a_worker_keeps_its_server_for_equal_episodes_and_not_beyond_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    from urlab_client.cluster.episodes import Job, Worker, setup_of
    from urlab_client.errors import ConnectionLost, UnknownActor

    monkeypatch.setattr(Worker, "node_id", lambda _: "here")
    job = Job(id=3, seed=1, scene="sim://arm", attempt=2)
    setup, other = (setup_of({"max_episode_steps": steps}, {}) for steps in (2, 3))
    worker = Worker()

    def steps(setup: Any = setup, error: Exception | None = None) -> Any:
        def policy(observation: Any, rng: np.random.Generator) -> Any:
            if error is not None:
                raise error
            return np.zeros(7)

        return worker.run(policy, setup, job)

    try:
        episode = steps()
        assert (episode.id, episode.seed, episode.attempt, episode.node_id) == (3, 1, 2, "here")
        assert (episode.scene, episode.address, episode.pid) == ("sim://arm", "sim://arm", os.getpid())
        assert (len(episode.actions), episode.terminated, episode.truncated) == (2, False, True)
        kept = worker._env
        steps()
        assert worker._env is kept
        with pytest.raises(UnknownActor):
            steps(error=UnknownActor("unknown_actor", "refused"))
        assert worker._env is kept, "a refusal says nothing against the server"
        assert len(steps(other).actions) == 3
        assert worker._env is not kept
        with pytest.raises(ConnectionLost):
            steps(other, ConnectionLost("gone"))
        assert worker._env is None
    finally:
        worker.close()


def test_addresses_pass_from_holder_to_holder(monkeypatch: pytest.MonkeyPatch) -> None:
    from urlab_client.cluster import leases

    now = 100.0
    monkeypatch.setattr(leases, "time", SimpleNamespace(monotonic=lambda: now))
    book = leases.Book(["a", "b"], ttl=30.0)
    assert [book.take(holder) for holder in ("one", "two", "late")] == ["a", "b", None]
    book.give_back("one")
    assert book.take("three") == "a"
    assert book.holders() == {"a": "three", "b": "two"}
    now = 125.0
    assert book.renew("three")
    now = 130.0
    assert book.holders() == {"a": "three", "b": None}
    assert not book.renew("two")
    assert book.take("five") == "b", "it goes to whoever waits"
    book.give_back("two")
    assert book.holders() == {"a": "three", "b": "five"}, "what an earlier holder gives back is no longer its own"
    assert book.server_lease("a") is None
    assert [book.server_lease("a", lease) for lease in ("first", "second")] == ["first", "second"]
    assert (book.server_lease("a"), book.server_lease("b")) == ("second", None)


def test_a_cluster_that_cannot_place_a_worker_is_not_waited_for(cluster: Any) -> None:
    from urlab_client.cluster import RolloutError, rollouts

    nowhere = {"resources": {"a thing that no node has": 1}}
    with pytest.raises(RolloutError, match=r"placed no worker within 0\.1 s.*It has .*worker_options"):
        list(rollouts(noisy(), "sim://arm", 1, worker_options=nowhere, start_timeout=0.1, **OPTIONS))


@pytest.mark.parametrize("dialect", ["alpha", "beta"])
def test_a_lease_comes_back_from_a_killed_worker(cluster: Any, tmp_path: Path, dialect: Any) -> None:
    from urlab_client.cluster import LeaseLost, LeasePool, rollouts

    with SimulatedServer("arm", play=True, dialect=dialect) as server:
        address = f"{server.address}:{server.step_port}"
        pool = LeasePool([address], name="arms", ttl=600)  # far longer than this test
        policy = dies_once(tmp_path / "killed")
        got = list(rollouts(policy, pool, 3, **OPTIONS))
        assert sorted((episode.id, episode.scene, episode.address) for episode in got) == [
            (i, "arms", address) for i in range(3)
        ]
        assert sorted(episode.attempt for episode in got) == [1, 1, 2]
        assert pool.holders() == {address: None}
        with pool.lease("me") as lease:
            assert (lease.address, pool.holders()) == (address, {address: "me"})
            with pytest.raises(LeaseLost, match="No address of 'arms' was free"), pool.lease("you", timeout=0.1):
                pass
        pool.close()


def test_a_server_in_use_outside_the_pool_is_left_alone(cluster: Any) -> None:
    from urlab_client.cluster import LeasePool

    with (
        SimulatedServer("arm", play=True, dialect="beta") as server,
        URLabClient(**server.client_options()) as outside,
        URLabClient(**server.client_options()) as client,
    ):
        pool = LeasePool([f"{server.address}:{server.step_port}"])
        outside.discover()
        theirs = outside.farm.acquire_lease("somebody else")
        client.discover()
        with pool.lease("me") as lease:
            with pytest.raises(LeaseBusy), lease.of_server(client):
                pass
            client.farm.release_lease(theirs)
            with lease.of_server(client), pytest.raises(LeaseBusy):
                client.farm.acquire_lease("yet another")
            client.farm.release_lease(client.farm.acquire_lease("free again"))
        pool.close()


def test_leasing_needs_no_one_who_gives_back(cluster: Any) -> None:
    from urlab_client.cluster import LeaseLost, LeasePool

    pool = LeasePool(["tcp://editor:1"], ttl=0.2)
    with pool.lease("dead") as lease, pool.lease("next", timeout=30):  # waits until the first one ran out
        assert pool.holders()["tcp://editor:1"] in {"next", None}
        with pytest.raises(LeaseLost, match="expired"):
            lease.keep()
    pool.close()


def test_a_policy_that_raises_ends_the_run_with_its_error(cluster: Any) -> None:
    from urlab_client.cluster import RolloutError, rollouts

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        raise ZeroDivisionError("in the policy")

    with pytest.raises(RolloutError, match=r"Episode 0 raised ZeroDivisionError: in the policy"):
        list(rollouts(policy, "sim://arm", 2, n_workers=1, **OPTIONS))


def test_what_a_server_refuses_is_not_asked_again(cluster: Any) -> None:
    from urlab_client.cluster import RolloutError, rollouts

    options = OPTIONS | {"env_options": {"keyframe": "away"}}
    with pytest.raises(RolloutError, match=r"Episode 0 raised UnknownKeyframe: .*Known: 'home'"):
        list(rollouts(noisy(), "sim://arm", 2, n_workers=1, **options))


def test_a_scene_that_no_server_can_load_uses_up_the_attempts(cluster: Any) -> None:
    from urlab_client.cluster import RolloutError, rollouts

    with pytest.raises(RolloutError, match="Episode 0 failed 2 times"):
        list(rollouts(noisy(), "sim://no-such-robot", 1, retries=1, **OPTIONS))


def waits_forever(notes: Path, fifo: Path) -> Any:
    """Return a policy that notes the children's process ids and then waits for what nobody writes."""
    notes_name, fifo_name = str(notes), str(fifo)
    os.mkfifo(fifo_name)

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        children = [file.read_text() for file in Path("/proc/self/task").glob("*/children")]
        Path(notes_name).write_text("".join(children))
        return os.read(os.open(fifo_name, os.O_RDONLY), 1)

    return policy


@pytest.fixture
def too_late(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let 100 s pass for the run as soon as a policy waits at the other end of `fifo`."""
    writers: list[int] = []

    def clock() -> float:
        if not writers:
            with contextlib.suppress(OSError):  # as long as nobody reads: the policy does not wait yet
                writers.append(os.open(tmp_path / "fifo", os.O_WRONLY | os.O_NONBLOCK))
        return time.monotonic() + 100 * len(writers)

    monkeypatch.setattr(import_module("urlab_client.cluster.rollouts"), "time", SimpleNamespace(monotonic=clock))
    yield
    for writer in writers:
        os.close(writer)


@pytest.mark.usefixtures("too_late")
def test_an_attempt_that_takes_too_long_is_ended_with_its_server(cluster: Any, tmp_path: Path) -> None:
    from urlab_client.cluster import RolloutError, rollouts

    policy = waits_forever(tmp_path / "notes", tmp_path / "fifo")
    with pytest.raises(RolloutError, match=r"Episode 0 failed 1 times.*not finished within 90 s"):
        list(rollouts(policy, "sim://arm", 1, retries=0, episode_timeout=90, **OPTIONS))
    assert gone(tmp_path / "notes")


def waits_once(fifo: Path, notes: Path, pool: Any) -> Any:
    """Return a policy that notes who holds the pool's address, and whose first attempt waits for what nobody writes."""
    fifo_name, notes_name = str(fifo), str(notes)
    os.mkfifo(fifo_name)
    Path(notes_name).touch()

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        seen = Path(notes_name).read_text().split()
        (holder,) = pool.holders().values()
        if holder not in seen:
            Path(notes_name).write_text(" ".join([*seen, str(holder)]))
        if not seen:
            os.read(os.open(fifo_name, os.O_RDONLY), 1)
        return rng.normal(scale=0.3, size=7)

    return policy


@pytest.mark.usefixtures("too_late")
def test_an_attempt_that_takes_too_long_leaves_its_lease_to_the_next(cluster: Any, tmp_path: Path) -> None:
    from urlab_client.cluster import LeasePool, rollouts

    with SimulatedServer("arm", play=True) as server:
        address = f"{server.address}:{server.step_port}"
        pool = LeasePool([address], ttl=600)  # far longer than this test
        policy = waits_once(tmp_path / "fifo", tmp_path / "notes", pool)
        (episode,) = rollouts(policy, pool, 1, retries=1, episode_timeout=90, **OPTIONS)
        assert episode.attempt == 2
        first, second = (tmp_path / "notes").read_text().split()
        assert first != second, "what the first attempt gives back late is not the second's"
        assert pool.holders() == {address: None}
        pool.close()


async def test_a_cancelled_run_leaves_no_worker_and_no_server(cluster: Any, tmp_path: Path) -> None:
    from urlab_client.cluster import rollouts

    notes, fifo = tmp_path / "notes", tmp_path / "fifo"
    policy = waits_forever(notes, fifo)
    writers: list[int] = []
    with anyio.CancelScope() as scope:
        async with rollouts(policy, "sim://arm", 1, **OPTIONS) as episodes, anyio.create_task_group() as tasks:

            async def leave() -> None:
                # Opening returns when the policy waits at the other end.
                writers.append(await anyio.to_thread.run_sync(os.open, fifo, os.O_WRONLY))
                scope.cancel()

            tasks.start_soon(leave)
            await anext(episodes)
    assert scope.cancelled_caught
    assert gone(notes)
    os.close(writers[0])


@pytest.mark.parametrize(
    ("scenes", "options", "problem"),
    [
        ([], {}, "scenes must be one or more"),
        ("tcp://editor", {}, "scenes must be one or more sim://"),
        ("sim://arm", {"retries": -1}, "retries must be 0 or more"),
        ("sim://arm", {"episode_timeout": 0}, "above 0 seconds"),
        ("sim://arm", {"env_options": {"render_mode": "rgb_array"}}, "env_options cannot have render_mode"),
        ("sim://arm", {"ids": [0, 1]}, "ids must be unique and from 0 to 0"),
    ],
)
def test_bad_options_are_named(cluster: Any, scenes: Any, options: dict[str, Any], problem: str) -> None:
    from urlab_client.cluster import rollouts

    with pytest.raises(ValueError, match=problem):
        rollouts(noisy(), scenes, 1, **options)


def test_a_removed_node_loses_and_doubles_no_episode(cluster: Any, expected: dict[int, Any], tmp_path: Path) -> None:
    from urlab_client.cluster import WorkerPool, rollouts

    victim = cluster.list_all_nodes()[-1]
    inner, victim_id, fifo = noisy(), victim.node_id, str(tmp_path / "fifo")
    os.mkfifo(fifo)

    def policy(observation: Any, rng: np.random.Generator) -> Any:
        import ray

        if ray.get_runtime_context().get_node_id() == victim_id:
            Path(fifo).read_text()  # waits here until the node is removed
        return inner(observation, rng)

    with WorkerPool(2) as workers:
        with rollouts(policy, "sim://arm", 6, workers=workers, **OPTIONS) as episodes:
            got = [next(episodes)]
            # Opening succeeds when the worker on the node has begun an episode and waits in its first step.
            with open(fifo, "w"):
                cluster.remove_node(victim, allow_graceful=False)
            got += episodes
        again = list(rollouts(policy, "sim://arm", 6, ids=[1, 3], workers=workers, **OPTIONS))
    assert sorted(episode.id for episode in got) == list(range(6))
    assert {episode.node_id for episode in [*got, *again]} == {got[0].node_id} != {victim_id}
    assert max(episode.attempt for episode in got) == 2
    assert {episode.pid for episode in again} <= {episode.pid for episode in got}
    for episode in [*got, *again]:
        same(episode, expected[episode.id])
