"""Arguments of the wrong type: the error is the method's, and says what it takes, whichever method it is."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import product
from typing import Any

import pytest

from urlab_client import URLabClient, URLabError
from urlab_client.integrations.gym import URLabEnv
from urlab_client.protocol.messages.session import Step
from urlab_client.server import SimulatedServer
from urlab_client.sync._facade import aio_of, portal_of

STRANGE = (None, "x", 1.5, object(), {"x": "y"})
# They end play or the client, take over the server, run for as long as they are told, or take any value.
LEFT_OUT = {
    *("close", "discover", "resync", "start", "stop", "create_level", "load_level", "run_for", "matches"),
    *("add_observer", "remove_observer", "acquire_lease", "release_lease"),
}

PYTHONS_OWN = re.compile(
    r"object is not|object has no |not supported between|unsupported operand|must be real|expected str"
    r"|unhashable|is not a valid (?!\w+: use )|could not convert|^None$|^'[^']*'$"
)


@pytest.fixture(scope="module")
def client() -> Iterator[URLabClient]:
    with (
        SimulatedServer("arm", dialect="beta", play=True) as server,
        URLabClient(**server.client_options(), step_mode="direct", rcv_timeout_ms=2000) as client,
    ):
        client.discover()
        yield client


def methods(of: object) -> list[tuple[str, inspect.Signature]]:
    found = inspect.getmembers(type(of), inspect.isfunction)
    return [(name, inspect.signature(method)) for name, method in found if name[0] != "_" and name not in LEFT_OUT]


@contextmanager
def noting(unnamed: list[str], shown: str) -> Iterator[None]:
    """Let a call fail that says what was wrong, and note one whose error is Python's own."""
    try:
        yield
    except (URLabError, OSError):
        pass
    except (TypeError, ValueError, KeyError) as error:
        if PYTHONS_OWN.search(str(error)):
            unnamed.append(f"{shown}: {error}")
    except Exception as error:  # noqa: BLE001
        unnamed.append(f"{shown}: {error!r}")


@pytest.mark.parametrize("request_", ["x", "step", Step, None])
def test_what_is_not_a_request_is_refused_by_name(client: URLabClient, request_: Any) -> None:
    with pytest.raises(TypeError, match=f"call takes a request .*got {re.escape(repr(request_))}"):
        client.call(request_)


PARTS = (
    *("client", "articulation", "camera"),
    *("scene", "outliner", "runtime", "debug", "viewport", "sim", "recording", "replay", "farm"),
)


@pytest.mark.parametrize(
    ("part", "flavour"),
    [("joint", "both"), ("actuator", "both"), *product(PARTS, ("blocking", "async"))],
)
def test_the_error_says_what_was_wrong(client: URLabClient, part: str, flavour: str) -> None:
    arm = client.articulations["arm"]
    parts: dict[str, Any] = {
        "client": client,
        "articulation": arm,
        "joint": arm.joints["elbow"],
        "actuator": arm.actuators["elbow"],
        "camera": arm.cameras["wrist"],
    }
    tried = parts.get(part) or getattr(client, part)
    if flavour == "async":
        tried = aio_of(tried)
    unnamed: list[str] = []
    for method, signature in methods(tried):
        named = [parameter for parameter in signature.parameters.values() if parameter.name not in {"self", "timeout"}]
        in_time = {"timeout": 2.0} if "timeout" in signature.parameters else {}  # also for pictures that never come
        needed = [parameter.name for parameter in named if parameter.default is parameter.empty]
        for parameter in named:
            for value in STRANGE:
                given = dict.fromkeys(needed, "x") | {parameter.name: value} | in_time
                shown = f"{part}.{method}({parameter.name}={value!r})"
                call = partial(getattr(tried, method), **given)
                with noting(unnamed, shown):
                    portal_of(client).call(call) if inspect.iscoroutinefunction(call.func) else call()
    assert not unnamed, "\n".join(unnamed)


@pytest.fixture
def fresh() -> Iterator[URLabClient]:
    """A client that no other test has left in another mode or with wrenches to send."""
    with SimulatedServer("arm", play=True) as server, URLabClient(**server.client_options()) as made:
        made.discover()
        yield made


def test_an_environment_says_what_was_wrong(fresh: URLabClient) -> None:
    unnamed: list[str] = []
    for name in list(inspect.signature(URLabEnv).parameters)[1:]:
        for value in (*STRANGE, [1], [None], [[]], b"x", -1):
            drawn = {"render_mode": "rgb_array"} if name == "render_camera" else {}
            with noting(unnamed, f"{name}={value!r}"):
                URLabEnv(fresh, **{**drawn, name: value}).reset(options=value if name == "task" else None)
    assert not unnamed, "\n".join(unnamed)
