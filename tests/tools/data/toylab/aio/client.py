"""The client."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Self

from toylab.aio.namespaces import Scene
from toylab.aio.robots import Body, Controller, Robot, make_controller
from toylab.aio.session import DEFAULT, Session, Timeout
from urlab_client.values.names import NameMap

__all__ = ["Client"]


class Client:
    """A client.

    >>> from toylab.aio import Client
    >>> async with Client() as client:
    ...     await client.step(2)
    """

    scene: Scene
    """Scene ops."""
    robots: NameMap[Robot]
    """Robots by name."""

    __slots__ = ("__weakref__", "_session", "bodies_by_id", "options", "robots", "scene")

    def __init__(self, address: str = "tcp://localhost", *, step_mode: str | None = "auto", **options: int) -> None:
        """Make a client; nothing is sent.

        Args:
            address: Where the server is.
            step_mode: `auto`, "direct" or None.
            **options: More.
        """
        if not address:
            raise ValueError("no address")
        self._session = Session()
        self._session.log.append((address, step_mode, options))
        self.options = options
        self.scene = Scene(self._session)
        dog = Robot(self._session, "dog_1")
        self.robots = NameMap({"dog_1": dog}, {"dog": ["dog_1"]}, "robot")
        self.bodies_by_id: dict[int, Body] = {1: Body(self._session, "ball"), 2: dog}

    bodies_by_id: dict[int, Body]
    """Bodies and robots by id."""

    options: dict[str, int]
    """What else was asked for."""

    async def step(self, n_steps: int = 1, *, timeout: Timeout = DEFAULT) -> int:
        """Step. `await client.step()` returns the count; see `__aenter__`."""
        await self._session.call("step", n_steps, timeout)
        return n_steps

    async def fail(self, error: BaseException) -> None:
        """Raise an error."""
        raise error

    async def find(self, name: str) -> Body | None:
        """Find a body."""
        return next((body for body in self.bodies_by_id.values() if body.name == name), None)

    def local(self, progress: Callable[[float], None], limits: Mapping[str, float] = {"speed": 1.0}) -> Controller:
        """Do something locally."""
        progress(limits["speed"])
        return make_controller(self._session)

    def __len__(self) -> int:
        """Return the number of robots."""
        return len(self.robots)

    def __repr__(self) -> str:
        return "<Client>"

    async def __aenter__(self) -> Self:
        """Return itself."""
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the client."""
        await self.close()

    async def close(self) -> None:
        """Close the client."""
        await self._session.call("close")
