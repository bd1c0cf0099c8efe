"""The pytest plugin, run as its users run it: on test files of their own."""

from __future__ import annotations

from pathlib import Path

import pytest

# An inner run in this process forgets what it imported, but NumPy loads only once.
import pytest_urlab.pool  # noqa: F401
import urlab_client  # noqa: F401

pytest_plugins = ["pytester"]

# What these runs have in common with each other, but not with those of users: modules of the outer run, and settings of
# a plugin that is switched off.
OURS = ("-W", "ignore:Module already imported", "-W", "ignore:Unknown config option")
PLUGINS = (
    "-p",
    "pytest_urlab",
    "-p",
    "no:cacheprovider",
    "-p",
    "no:hypothesispytest",
    "--strict-markers",
    "-W",
    "error",
    *OURS,
)
ALONE = ("-p", "no:asyncio", "-p", "no:anyio", "-p", "no:benchmark")
"""Without other plugins, which import what they like."""


def run(pytester: pytest.Pytester, text: str, *options: str) -> pytest.RunResult:
    pytester.makepyfile(text)
    return pytester.runpytest_inprocess(*PLUGINS, *options)


@pytest.fixture(autouse=True)
def settings(pytester: pytest.Pytester) -> None:
    pytester.makeini("[pytest]\nasyncio_default_fixture_loop_scope = function\n")


def test_a_server_and_both_clients(pytester: pytest.Pytester) -> None:
    text = """
        import pytest

        def test_blocking(urlab_client, urlab_server):
            assert urlab_client.config.step_port == urlab_server.step_port
            assert list(urlab_client.articulations) == ["arm"]

        @pytest.mark.asyncio
        async def test_async(urlab_aio_client):
            assert list(urlab_aio_client.articulations) == ["arm"]

        @pytest.mark.asyncio(loop_scope="module")
        async def test_async_on_the_loop_of_the_module(urlab_aio_client):
            await urlab_aio_client.runtime.forward()

        @pytest.mark.urlab("quadruped", step_mode="direct")
        def test_another_robot(urlab_client):
            assert urlab_client.step(3).step == 3
            assert list(urlab_client.articulations) == ["quadruped"]

        @pytest.mark.urlab("ball", play=False)
        def test_without_play(urlab_client):
            assert not urlab_client.manager_present
        """
    run(pytester, text).assert_outcomes(passed=5)


def test_each_test_finds_the_initial_state(pytester: pytest.Pytester) -> None:
    text = """
        import pytest

        ports = []
        pytestmark = pytest.mark.urlab("ball", step_mode="direct")

        @pytest.mark.parametrize("ending", [None, "close the client", "close the server", "stop play", "import"])
        def test_it(urlab_server, urlab_client, urlab_faults, ending):
            assert urlab_client.sim_time == 0.0
            assert not urlab_faults.active
            assert [blueprint.short_name for blueprint in urlab_client.outliner.list_blueprints()] == ["ball"]
            urlab_client.step(10)
            ports.append(urlab_server.step_port)
            if ending == "close the client":
                urlab_client.close()
            if ending == "close the server":
                urlab_server.close()
            if ending == "stop play":
                urlab_client.sim.stop()
            if ending == "import":
                urlab_client.scene.import_xml("arm")

        def test_one_more(urlab_client):
            assert urlab_client.step().step == 1
            assert len(set(ports)) == 2, "only the closed server was started again before the last test"
        """
    run(pytester, text).assert_outcomes(passed=6)


def test_faults_go_with_the_test(pytester: pytest.Pytester) -> None:
    text = """
        import pytest
        from urlab_client import URLabTimeoutError
        from urlab_client.server import Drop

        def test_lost(urlab_client, urlab_faults):
            with urlab_faults.add(Drop("forward")) as lost:
                while not lost.applied:  # the server may be late to take a request
                    with pytest.raises(URLabTimeoutError):
                        urlab_client.runtime.forward(timeout=0.05)
            urlab_faults.add(Drop())

        def test_not_lost(urlab_client):
            urlab_client.runtime.forward()
        """
    run(pytester, text).assert_outcomes(passed=2)


def test_a_server_with_a_dead_thread_is_replaced_and_told_of(pytester: pytest.Pytester) -> None:
    text = """
        import ctypes
        import threading

        import pytest

        def strike(server=None):
            *_, physics = [thread for thread in threading.enumerate() if thread.name == "urlab-physics"]  # the newest
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(physics.ident), ctypes.py_object(SystemExit))
            physics.join()

        def test_that_breaks_it(urlab_client, urlab_server):
            strike()
            assert urlab_server.failure

        @pytest.fixture
        def breaks_it_before():
            strike()

        def test_that_finds_it_broken(breaks_it_before, urlab_client):
            urlab_client.runtime.forward()

        def test_after_that(urlab_client):
            urlab_client.runtime.forward()
        """
    result = run(pytester, text, "-W", "default::pytest.PytestWarning")
    result.assert_outcomes(passed=3, warnings=2)
    result.stdout.fnmatch_lines(
        [
            "*the simulated server failed during this test*'urlab-physics' died of SystemExit*",
            "*the simulated server failed after the previous test*'urlab-physics' died of SystemExit*",
        ]
    )


def test_files_lie_beside_the_test_and_the_default_is_chosen_in_conftest(pytester: pytest.Pytester) -> None:
    pytester.makeconftest(
        """
        import pytest

        @pytest.fixture(scope="session")
        def urlab_default():
            return pytest.mark.urlab("mine.xml", "ball")
        """
    )
    folder = pytester.mkpydir("inner")
    (folder / "mine.xml").write_text("<mujoco><worldbody><body name='b'><geom size='1'/></body></worldbody></mujoco>")
    (folder / "test_mine.py").write_text(
        "def test_it(urlab_client):\n    assert list(urlab_client.articulations) == ['mine', 'ball']\n"
    )
    pytester.runpytest_inprocess(*PLUGINS).assert_outcomes(passed=1)


def test_a_mark_that_cannot_work_says_why(pytester: pytest.Pytester) -> None:
    text = """
        import pytest

        @pytest.mark.urlab("no_such_robot")
        def test_model(urlab_server):
            pass

        @pytest.mark.urlab("arm", colour="red")
        def test_option(urlab_server):
            pass

        @pytest.mark.urlab("arm", step_port=-1)
        def test_value(urlab_server):
            pass
        """
    result = run(pytester, text)
    result.assert_outcomes(errors=3)
    result.stdout.fnmatch_lines(
        [
            "*@pytest.mark.urlab did not start: no_such_robot is neither a file nor a bundled robot*",
            "*@pytest.mark.urlab did not start: *unexpected keyword argument 'colour'",
            "*@pytest.mark.urlab did not start: step_port must be a number from 0 to 65535, not -1",
        ]
    )


def test_anyio_runs_the_async_client(pytester: pytest.Pytester) -> None:
    text = """
        import pytest

        @pytest.fixture
        def anyio_backend():
            return "asyncio"

        @pytest.mark.anyio
        async def test_it(urlab_aio_client):
            await urlab_aio_client.runtime.forward()
        """
    run(pytester, text).assert_outcomes(passed=1)
    pytester.runpytest_inprocess(*PLUGINS, "-p", "no:asyncio").assert_outcomes(passed=1)


@pytest.mark.parametrize("scope", ["function", "module"])
def test_in_its_auto_mode_pytest_asyncio_runs_what_is_marked_with_anyio(pytester: pytest.Pytester, scope: str) -> None:
    text = """
        import pytest

        @pytest.fixture
        def anyio_backend():
            return "asyncio"

        @pytest.mark.anyio
        async def test_marked(urlab_aio_client):
            await urlab_aio_client.runtime.forward()

        async def test_not_marked(urlab_aio_client):
            await urlab_aio_client.runtime.forward()
        """
    result = run(pytester, text, "-o", "asyncio_mode=auto", "-o", f"asyncio_default_test_loop_scope={scope}")
    result.assert_outcomes(passed=2)


def test_without_a_runner_the_async_fixture_says_what_is_missing(pytester: pytest.Pytester) -> None:
    text = """
        def test_blocking(urlab_client):
            urlab_client.runtime.forward()

        def test_async(urlab_aio_client):
            pass
        """
    result = run(pytester, text, "-p", "no:asyncio")
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines(["*urlab_aio_client needs*pytest-asyncio*"])


def test_workers_have_servers_of_their_own(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.parametrize("number", range(4))
        def test_it(urlab_client, number):
            assert urlab_client.sim_time == 0.0
            urlab_client.runtime.set_mode("direct")
            urlab_client.step(5)
        """
    )
    pytester.runpytest_subprocess(*PLUGINS, *ALONE, "-n", "2").assert_outcomes(passed=4)


def test_who_does_not_use_it_does_not_pay(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import sys

        def test_it():
            assert "pytest_urlab" in sys.modules
            assert not {"urlab_client", "mujoco", "numpy", "zmq", "msgspec"} & set(sys.modules)
        """
    )
    pytester.runpytest_subprocess(*PLUGINS, *ALONE).assert_outcomes(passed=1)


def test_the_plugin_is_announced() -> None:
    import tomllib

    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["project"]["entry-points"]["pytest11"] == {"pytest_urlab": "pytest_urlab"}
