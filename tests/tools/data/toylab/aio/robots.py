"""Bodies and robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from toylab.aio.session import DEFAULT, Session, Timeout
from urlab_client.values.names import Local, NameMap

if TYPE_CHECKING:
    from toylab.aio.streams import Stream

__all__ = ["Body", "Controller", "Joint", "PDController", "Robot", "make_controller"]

_Vector = Sequence[float]


class Joint:
    """A joint: local, so both flavours share the class."""

    name: str
    """Its name."""

    def __init__(self, name: str) -> None:
        self.name = name

    def neighbour(self) -> Joint | None:
        """Return the next joint."""
        return None


class Controller:
    """A controller."""

    def __init__(self, session: Session) -> None:
        self._session = session

    async def configure(self, *, timeout: Timeout = DEFAULT, **params: float) -> dict[str, float]:
        """Push parameters and return them."""
        await self._session.call("configure", timeout, params)
        return params


class PDController(Controller):
    """A controller with gains."""

    async def set_gains(self, kp: float = 1.5e-2) -> dict[str, float]:
        """Set the gains."""
        return await self.configure(kp=kp)


class Body:
    """Has nothing asynchronous, but a derived class has."""

    name: str
    """Its name.

    Unique in the scene.
    """

    def __init__(self, session: Session, name: str) -> None:
        self._session = session
        self.name = name
        self._pos: _Vector = (0.0, 0.0, 0.0)

    @property
    def pos(self) -> _Vector:
        """Position, metres."""
        return self._pos

    @pos.setter
    def pos(self, value: _Vector) -> None:
        self._pos = value

    def push(self, force: _Vector = (0, 0, 0)) -> None:
        """Push it."""
        self._session.log.append(("push", force))

    def _hidden(self) -> None: ...


class Battery(Local):
    """Local, and never anything else: both flavours share the class."""

    __slots__ = ()

    _state: list[float]

    @property
    def charge(self) -> float:
        """What is left of 1."""
        return self._state[-1]


class LocalCharger(Battery):
    """Local, but a derived class is not: a base class of both flavours."""

    __slots__ = ()

    def charge_to(self, level: float) -> None:
        """Note a level."""
        self._state.append(level)


class Charger(LocalCharger):
    """A charger."""

    async def wait(self) -> float:
        """Wait until it is full."""
        return self.charge


class Robot(Body):
    """A robot."""

    joints: NameMap[Joint]
    """Its joints."""

    batteries: NameMap[Battery]
    """Its batteries, of which one is in a charger."""

    def __init__(self, session: Session, name: str) -> None:
        super().__init__(session, name)
        self.batteries = NameMap({"spare": Battery([0.5]), "main": Charger([0.9])}, {}, "battery")
        self.joints = NameMap({"hip": Joint("hip")}, {}, "joint")
        self._controller: Controller | None = PDController(session)

    @property
    def controller(self) -> Controller | None:
        """Its controller, or None."""
        return self._controller

    def states(self) -> Stream[float]:
        """Stream its state."""
        from toylab.aio.streams import Stream

        return Stream([0.5, 1.5])


def make_controller(session: Session) -> Controller:
    return PDController(session)
