"""Switching cameras on for as long as somebody here receives their pictures, on servers whose cameras rest otherwise.

For the publishers. The switch of a server is one for all its clients, so a camera that nobody here looks at any more is
switched off only by the client that switched it on.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from urlab_client.aio.session import Session
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.messages.cameras import CameraSwitch as Places
from urlab_client.protocol.messages.cameras import SetCameraStreaming
from urlab_client.protocol.messages.session import CameraInfo

__all__ = ["CameraSwitch"]

log = logging.getLogger("urlab_client.client")

_OFF_S = 1.0


class CameraSwitch:
    """The cameras that one client has switched on.

    Args:
        session: What the switching is sent over.
        refresh: Called when pictures come from elsewhere than before.
    """

    def __init__(self, session: Session, refresh: Callable[[], None]) -> None:
        self._session = session
        self._refresh = refresh
        self._users: dict[str, int] = {}
        self._infos: dict[str, CameraInfo] = {}
        self._on: set[str] = set()
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    def use(self, info: CameraInfo) -> None:
        """Switch a camera on, unless it is; from the event loop."""
        topic = info.zmq_topic
        self._users[topic] = self._users.get(topic, 0) + 1
        self._infos[topic] = info
        self._follow()

    def leave(self, info: CameraInfo) -> None:
        """Switch a camera off, unless somebody else here uses it; from the event loop."""
        topic = info.zmq_topic
        left = self._users.get(topic, 0) - 1
        if left > 0:
            self._users[topic] = left
        else:
            self._users.pop(topic, None)
        self._follow()

    def restart(self, infos: list[CameraInfo]) -> None:
        """Follow a handshake: a play session begins with its cameras switched off."""
        self._on.clear()
        self._infos = {info.zmq_topic: info for info in infos}
        self._follow()

    async def aclose(self, *, connected: bool) -> None:
        """Switch off what is on, as far as the server listens. Idempotent."""
        self._closed = True
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))
        on, self._on = self._on, set()
        if on and connected:
            try:
                await self._send(dict.fromkeys(on, False), timeout=_OFF_S)
            except URLabError as error:  # a courtesy: the server may have moved on
                log.debug("cameras could not be switched off: %s", error)

    def _follow(self) -> None:
        if self._closed or not self._session.features.camera_switch or self._due() == {}:
            return
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._switch(), name="urlab-cameras")

    def _due(self) -> dict[str, bool]:
        wanted = {topic for topic in self._users if topic in self._infos}
        return dict.fromkeys(wanted - self._on, True) | dict.fromkeys(self._on - wanted, False)

    async def _switch(self) -> None:
        while due := self._due():
            try:
                await self._send(due)
            except URLabError as error:
                log.warning("cameras could not be switched: %s", error)
                return

    async def _send(self, due: dict[str, bool], timeout: float | None = 6.5) -> None:
        # What is not mentioned is switched off, so both places are.
        request = SetCameraStreaming(cameras={topic: Places(zmq=on, shm=on) for topic, on in due.items()})
        reply = await self._session.call(request, timeout=timeout)
        for topic, on in due.items():
            (self._on.add if on else self._on.discard)(topic)
        for told in reply.cameras.values():
            info = self._infos.get(told.zmq_topic or "")
            if info is not None and told.zmq_endpoint is not None:
                info.zmq_endpoint = told.zmq_endpoint
        self._refresh()
