"""Those who look on: what they are told, what they can ask for, and that they disturb nobody."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from urlab_client import ClientObserver
from urlab_client.protocol.messages.session import ForwardOk, ResetOk, StepOk


class Notes(ClientObserver):
    """Writes down what it is told."""

    def __init__(self, cameras: dict[str, str] | None = None) -> None:
        self.told: list[Any] = []
        self.asked: list[int] = []
        self.cameras = cameras or {}

    def on_handshake(self) -> None:
        self.told.append("handshake")

    def on_state(self, state: Any) -> None:
        self.told.append(state)

    def step_cameras(self, n_steps: int) -> dict[str, str]:
        self.asked.append(n_steps)
        return self.cameras


class Broken(ClientObserver):
    """Fails at everything."""

    def on_handshake(self) -> None:
        raise RuntimeError("handshake")

    def on_state(self, state: object) -> None:
        raise RuntimeError("state")

    def step_cameras(self, n_steps: int) -> dict[str, str]:
        raise RuntimeError("cameras")


async def test_an_observer_is_told_of_handshakes_and_of_every_kind_of_state(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        notes = Notes()
        client.add_observer(notes)
        client.add_observer(notes)  # once is enough
        await client.discover()
        reply = await client.step(3)
        await client.reset()
        await client.runtime.forward()
        assert [told if isinstance(told, str) else type(told) for told in notes.told] == [
            "handshake",
            StepOk,
            ResetOk,
            ForwardOk,
        ]
        assert notes.told[1].step == reply.step
        assert notes.asked == [3]
        client.remove_observer(notes)
        client.remove_observer(notes)
        await client.step()
        await client.discover()
        assert len(notes.told) == 4


@pytest.mark.opengl
async def test_an_observer_gets_pictures_with_the_steps_of_others(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        await client.discover()
        notes = Notes({"overview": "sync", "no such camera": "latest"})
        client.add_observer(notes)
        (key,) = client.articulations
        reply = await client.step()
        assert list(reply.cameras) == [f"{key}/overview"] or list(reply.cameras) == ["overview"]
        reply = await client.step(include_cameras={f"{key}/overview": "latest"})
        assert list(reply.cameras) == [f"{key}/overview"], "what the caller asked for is not asked for twice"
        assert client.camera("overview").latest_frame is not None
        with pytest.raises(KeyError, match="no such camera"):
            client.camera("no such camera")


async def test_an_observer_that_fails_disturbs_neither_the_client_nor_others(
    connect: Any, serve: Any, caplog: pytest.LogCaptureFixture
) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="direct")
        notes = Notes()
        client.add_observer(Broken())
        client.add_observer(notes)
        with caplog.at_level(logging.ERROR, "urlab_client.client"):
            await client.discover()
            reply = await client.step()
        assert client.step_count == reply.step == 1
        assert [type(told) for told in notes.told] == [str, StepOk]
        assert [record.exc_info[1].args[0] for record in caplog.records if record.exc_info] == [
            "handshake",
            "cameras",
            "state",
        ]


async def test_a_snapshot_of_the_described_world_matches(connect: Any, serve: Any) -> None:
    with serve("arm", play=True) as server:
        client = connect(server, step_mode="live")
        await client.discover()
        snapshot = await client.state_stream().receive()
        assert client.matches(snapshot)
        snapshot.per_articulation["another robot"] = next(iter(snapshot.per_articulation.values()))
        assert not client.matches(snapshot)
