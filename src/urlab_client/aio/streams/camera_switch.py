"""Switching cameras on while this client receives their pictures, on servers whose cameras are off by default.

For the publishers and `client.runtime.set_camera_streaming`. All clients of a server share its switches, so only the
client that switched a camera on switches it off when it no longer uses the pictures.

The user's setting takes precedence over the streams: a camera that the user switched on stays on when its streams end.
A camera that the user switched off delivers nothing to its open streams until another stream requests its pictures.
The settings last until play ends.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping

from urlab_client.aio.background import background_task
from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.aio.session.session import Session, leaves_open
from urlab_client.errors import URLabError
from urlab_client.protocol.messages.cameras import CameraStreaming, CameraTransports, SetCameraStreaming
from urlab_client.protocol.messages.session import CameraInfo

log: logging.Logger = logging.getLogger("urlab_client.client")

_OFF_S = 1.0

# Name both transports: the server switches off any that is missing.
_ON = CameraTransports(zmq=True, shm=True)
_OFF = CameraTransports(zmq=False, shm=False)
_UNKNOWN = CameraTransports()  # the outcome of a request is, so the next one is due in any case


class CameraSwitch:
    """The cameras that one client has switched on."""

    def __init__(self, session: Session, refresh: Callable[[], None]) -> None:
        self._session = session
        self._refresh = refresh
        # All keyed by topic.
        self._infos: dict[str, CameraInfo] = {}
        self._users: dict[str, int] = {}
        self._set: dict[str, CameraTransports] = {}  # by the user
        self._on: dict[str, CameraTransports] = {}  # through this client
        self._sending = asyncio.Lock()
        self._task: asyncio.Task[None] | None = None
        self._failure: URLabError | None = None
        self._closed = False

    def use(self, info: CameraInfo, *, asked: bool) -> None:
        """Switch a camera on if it is off. Call from the event loop."""
        topic = info.zmq_topic
        self._users[topic] = self._users.get(topic, 0) + 1
        self._infos[topic] = info
        if asked and self._set.get(topic) == _OFF:
            del self._set[topic]
        self._follow()

    def leave(self, info: CameraInfo) -> None:
        """Switch a camera off unless this client still uses it elsewhere. Call from the event loop."""
        topic = info.zmq_topic
        left = self._users.get(topic, 0) - 1
        if left > 0:
            self._users[topic] = left
        else:
            self._users.pop(topic, None)
        self._follow()

    def restart(self, infos: list[CameraInfo]) -> None:
        """Adopt the cameras of a handshake; a play session starts with its cameras off."""
        self._on.clear()
        self._infos = {info.zmq_topic: info for info in infos}
        self._follow()

    def is_on(self, info: CameraInfo) -> bool:
        return self._on.get(info.zmq_topic, _OFF) != _OFF

    def forget(self) -> None:
        """Discard all settings because play ended."""
        self._set.clear()
        self._on.clear()

    async def set(
        self, wanted: Mapping[str, CameraTransports], *, timeout: Timeout = DEFAULT
    ) -> dict[str, CameraStreaming]:
        """Switch cameras as the user requests.

        Returns:
            The server's reply for each camera that it knows, by topic.
        """
        async with self._sending:
            before = self._set
            self._set = {**before, **wanted}  # a stream opened during the request takes precedence
            try:
                return await self._send(wanted, timeout)
            except BaseException:
                for topic in wanted:
                    if topic in before:
                        self._set[topic] = before[topic]
                    else:
                        self._set.pop(topic, None)
                raise
            finally:
                self._follow()

    async def settle(self) -> None:
        """Send again what an abandoned request may have changed, and wait for it."""
        self._follow()
        await self.settled()

    async def settled(self) -> None:
        """Wait until the current settings have been sent to the server, or refused.

        Raises:
            URLabError: Sending failed unexpectedly.
        """
        if self._task is not None:
            await asyncio.wait((self._task,))
            if self._failure is not None:
                raise self._failure.with_traceback(None)  # each raise would add to it

    def _note_failure(self, error: URLabError) -> None:
        self._failure = error

    async def aclose(self, *, connected: bool) -> None:
        """Switch off the cameras that are on only for streams, if the server is connected. Idempotent."""
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
            except URLabError as error:  # best effort: play may have ended
                log.debug("cameras could not be switched off: %s", error)

    def _follow(self) -> None:
        if self._closed or not self._due():
            return
        if self._task is None or self._task.done():
            self._failure = None
            self._task = background_task(
                "urlab-cameras", self._switch(), tell=self._session.tell, failed=self._note_failure
            )

    def _due(self) -> dict[str, CameraTransports]:
        if self._session.read_only or not self._session.features.camera_switch:
            return {}
        return {topic: wanted for topic in self._infos if (wanted := self._wanted(topic)) != self._on.get(topic, _OFF)}

    def _wanted(self, topic: str) -> CameraTransports:
        by_user = self._set.get(topic)
        if topic not in self._users:
            return _OFF if by_user is None else by_user
        # A stream needs the socket, which is also the fallback for shared memory.
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
        try:
            reply = await self._session.call(SetCameraStreaming(cameras=dict(due)), timeout=timeout)
        except BaseException as error:
            if leaves_open(error):
                self._on |= dict.fromkeys(due, _UNKNOWN)
            raise
        for topic, wanted in due.items():
            if wanted == _OFF:
                self._on.pop(topic, None)
            else:
                self._on[topic] = wanted
        found: dict[str, CameraStreaming] = {}
        for name, streaming in reply.cameras.items():
            topic = _topic(name, streaming, due)
            info = self._infos.get(topic)
            if info is not None and streaming.zmq_endpoint is not None:
                info.zmq_endpoint = streaming.zmq_endpoint
            found[topic] = streaming
        self._refresh()
        return found


def _topic(name: str, streaming: CameraStreaming, requested: Mapping[str, CameraTransports]) -> str:
    """Return the requested topic that an entry of a reply refers to; some servers use only its last part."""
    if streaming.zmq_topic:
        return streaming.zmq_topic
    if name in requested:
        return name
    return next((topic for topic in requested if topic.rpartition("/")[2] == name), name)
