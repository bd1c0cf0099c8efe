"""Switching cameras on for as long as somebody here receives their pictures, on servers whose cameras rest otherwise.

For the publishers and `client.runtime.set_camera_streaming`. The switch of a server is one for all its clients, so a
camera that nobody here looks at any more is switched off only by the client that switched it on.

What the user sets goes before what streams need: a camera that was switched on stays on when its streams end, and one
that was switched off brings its open streams nothing, until another stream asks for its pictures. All of this ends with
play.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

from urlab_client.aio.deadline import DEFAULT, Timeout
from urlab_client.aio.session import Session
from urlab_client.protocol.errors import URLabError
from urlab_client.protocol.messages.cameras import CameraStreaming, CameraTransports, SetCameraStreaming
from urlab_client.protocol.messages.session import CameraInfo

__all__ = ["CameraSwitch"]

log: logging.Logger = logging.getLogger("urlab_client.client")

_OFF_S = 1.0

# What is not mentioned is switched off, so both transports are.
_ON = CameraTransports(zmq=True, shm=True)
_OFF = CameraTransports(zmq=False, shm=False)


class CameraSwitch:
    """The cameras that one client has switched on.

    Args:
        session: What the switching is sent over.
        refresh: Called when pictures come from elsewhere than before.
    """

    def __init__(self, session: Session, refresh: Callable[[], None]) -> None:
        self._session = session
        self._refresh = refresh
        # All by topic.
        self._infos: dict[str, CameraInfo] = {}
        self._users: dict[str, int] = {}
        self._set: dict[str, CameraTransports] = {}  # by the user
        self._on: dict[str, CameraTransports] = {}  # through this client
        self._sending = asyncio.Lock()
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    def use(self, info: CameraInfo, *, asked: bool) -> None:
        """Switch a camera on, unless it is; from the event loop.

        Args:
            info: The camera.
            asked: Whether the user asks for its pictures now, rather than having them received in the background.
        """
        topic = info.zmq_topic
        self._users[topic] = self._users.get(topic, 0) + 1
        self._infos[topic] = info
        if asked and self._set.get(topic) == _OFF:
            del self._set[topic]
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

    def is_on(self, info: CameraInfo) -> bool:
        """Return whether this client has switched a camera on."""
        return self._on.get(info.zmq_topic, _OFF) != _OFF

    def forget(self) -> None:
        """Note that play ended, and with it whatever cameras were told."""
        self._set.clear()
        self._on.clear()

    async def set(
        self, wanted: Mapping[str, CameraTransports], *, timeout: Timeout = DEFAULT
    ) -> dict[str, CameraStreaming]:
        """Switch cameras as the user says.

        Args:
            wanted: Where each is to stream, by topic.
            timeout: Seconds for the request.

        Returns:
            What the server says of those that it knows, by topic.
        """
        async with self._sending:
            before = self._set
            self._set = {**before, **wanted}  # so that a stream opened meanwhile has the last word
            try:
                return await self._send(wanted, timeout)
            except BaseException:
                for topic in wanted:  # it may have come about all the same
                    self._on.pop(topic, None)
                    if topic in before:
                        self._set[topic] = before[topic]
                    else:
                        self._set.pop(topic, None)
                raise
            finally:
                self._follow()

    async def settled(self) -> None:
        """Wait until the server has been told of what is used now."""
        if self._task is not None:
            await asyncio.wait((self._task,))

    async def aclose(self, *, connected: bool) -> None:
        """Switch off what is on for streams alone, as far as the server listens. Idempotent."""
        self._closed = True
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait((self._task,))
        self._users.clear()
        due = self._due()
        self._on.clear()
        if due and connected:
            try:
                await self._send(due, _OFF_S)
            except URLabError as error:  # a courtesy: the server may have moved on
                log.debug("cameras could not be switched off: %s", error)

    def _follow(self) -> None:
        if self._closed or not self._session.features.camera_switch or not self._due():
            return
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._switch(), name="urlab-cameras")

    def _due(self) -> dict[str, CameraTransports]:
        return {topic: wanted for topic in self._infos if (wanted := self._wanted(topic)) != self._on.get(topic, _OFF)}

    def _wanted(self, topic: str) -> CameraTransports:
        by_user = self._set.get(topic)
        if topic not in self._users:
            return _OFF if by_user is None else by_user
        # A stream has to have the socket, which is also what shared memory falls back on.
        return _ON if by_user is None or (by_user.shm and not by_user.zmq) else by_user

    async def _switch(self) -> None:
        while True:
            async with self._sending:
                due = self._due()
                if not due:
                    return
                try:
                    await self._send(due)
                except URLabError as error:
                    log.warning("cameras could not be switched: %s", error)
                    return

    async def _send(
        self, due: Mapping[str, CameraTransports], timeout: Timeout = DEFAULT
    ) -> dict[str, CameraStreaming]:
        reply = await self._session.call(SetCameraStreaming(cameras=dict(due)), timeout=timeout)
        for topic, wanted in due.items():
            if wanted == _OFF:
                self._on.pop(topic, None)
            else:
                self._on[topic] = wanted
        found: dict[str, CameraStreaming] = {}
        for name, told in reply.cameras.items():
            topic = _topic(name, told, due)
            info = self._infos.get(topic)
            if info is not None and told.zmq_endpoint is not None:
                info.zmq_endpoint = told.zmq_endpoint
            found[topic] = told
        self._refresh()
        return found


def _topic(name: str, told: CameraStreaming, asked: Mapping[str, CameraTransports]) -> str:
    """Return which of the topics that were asked for an entry of a reply is about; some servers call it by its part."""
    if told.zmq_topic:
        return told.zmq_topic
    if name in asked:
        return name
    return next((topic for topic in asked if topic.rpartition("/")[2] == name), name)
