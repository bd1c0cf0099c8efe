"""Turning a handshake into the client's state: the session, the local model, the scene and the step mode."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import warnings
from collections.abc import Callable
from functools import partial
from typing import Final

import anyio.to_thread

from urlab_client.aio.session.turn import Turn
from urlab_client.aio.state.scene_objects import examine
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.transport.subscriber import MessageHandler
from urlab_client.enums import StepMode
from urlab_client.errors import NoActiveManager, NotReady, ProtocolError, UnknownOp, URLabError, URLabVersionMismatch
from urlab_client.events import PlayStarted
from urlab_client.protocol.codec import decode_reply, op_of
from urlab_client.protocol.messages.session import NOT_SENT, Forward, ForwardOk, Hello, HelloOk, Meta
from urlab_client.protocol.messages.streams import StateSnapshot, StreamPolicy
from urlab_client.values.layouts import BytesLike

log: logging.Logger = logging.getLogger("urlab_client.client")

_PUBLISHED_S: Final = 1.0  # wait for a snapshot of a server that publishes ten per second, or more, in every mode
_PERHAPS_S: Final = 0.2  # of one that publishes one per tick in live mode, and none in the others


class Discovery:
    """Opens sessions and applies handshakes."""

    def __init__(
        self, state: SimState, *, local_model: bool, check_version: bool, promote: bool, trusted: bool
    ) -> None:
        self._state = state
        self._local_model = local_model
        self._check_version = check_version
        self._promote = promote
        self._trusted = trusted
        self._warned = ""  # the last warning about another version of MuJoCo

    async def open(self, turn: Turn, observations: str) -> HelloOk:
        """Open a session and apply its handshake."""
        state = self._state
        state.pending.handshake = True  # until it has been adopted
        hello = await state.session.hello(turn, Hello(observations=observations))
        state.level, state.level_to_restore = observations, None
        await self.adopt(turn, hello)
        return hello

    async def open_read_only(self, turn: Turn, handshake: bytes) -> None:
        """Apply the result of another client's `handshake()`, or raise `ValueError`, without opening a session."""
        session = self._state.session
        try:
            hello = decode_reply(op_of(Hello), HelloOk, handshake)
        except URLabError as error:
            raise ValueError(f"The argument is not a result of handshake(): {error}") from None
        listed = [op.name for op in (await turn.call(Meta())).ops]
        session.features = session.features.with_ops(listed).with_hello(hello)
        await self.adopt(turn, hello)

    async def _loadable(self, turn: Turn, hello: HelloOk) -> HelloOk:
        """Return a handshake whose model this process can and may load.

        Raises:
            URLabVersionMismatch: The model is from another MuJoCo build, and `check_version` is set.
            URLabError: The server is not trusted with binary models and offers no other.
        """
        mismatch = self._state.mirror.check_version(hello)
        if mismatch is not None:
            if self._check_version:
                raise mismatch
            if hello.mjcf_compiled is None:
                hello = await self._hello_with_assets(turn)
            self._warn_once(mismatch, has_xml=hello.mjcf_compiled is not None)
        if hello.mjb is not None and not self._trusted:
            hello = await self._without_binary(turn, hello)
        return hello

    def _warn_once(self, mismatch: URLabVersionMismatch, *, has_xml: bool) -> None:
        consequence = (
            "The local model is compiled here from XML and only approximates the server's."
            if has_xml
            else "There is no local model, because the server does not offer it as XML."
        )
        if self._warned != consequence:
            self._warned = consequence
            warnings.warn(f"{mismatch.args[0]} {consequence}", stacklevel=2)

    async def _hello_with_assets(self, turn: Turn) -> HelloOk:
        state = self._state
        hello = await state.session.hello(turn, Hello(observations=state.level, include_assets=True))
        state.level_to_restore = None
        return hello

    async def _without_binary(self, turn: Turn, hello: HelloOk) -> HelloOk:
        """Return the handshake with a model only in XML, because MuJoCo's binary loader is not safe for hostile models.

        Raises:
            URLabError: The server does not offer the model as XML.
        """
        if hello.mjcf_compiled is None:
            log.info("the server is not trusted with binary models: the local model is compiled here from XML")
            hello = await self._hello_with_assets(turn)
        if hello.manager_present and hello.mjcf_compiled is None:
            raise URLabError(
                "The server offers its model only in MuJoCo's binary format, which is loaded only from servers on this "
                "machine and servers known by their key.",
                op="hello",
                hint="Pass server_key=…, trust_server=True if you trust the network in between, or local_model=False.",
            )
        hello.mjb = None
        return hello

    async def adopt(self, turn: Turn, hello: HelloOk) -> None:
        """Apply a handshake: load its model, bind the wrappers and switch the server to the wanted step mode."""
        state = self._state
        hello.mjb_base64 = NOT_SENT  # it would keep the whole reply in memory
        await state.session.transport.follow(hello)
        loaded = None
        if self._local_model:
            if hello.mjb is not None:
                hello = await self._loadable(turn, hello)
            load = partial(state.mirror.load, hello, trusted=self._trusted)
            loaded = await turn.aside(anyio.to_thread.run_sync(load, abandon_on_cancel=True))
        examined = examine(hello, None if loaded is None else loaded.model)
        state.publishers.check_open()
        # From here on nothing awaits until the handshake is fully applied, so a cancellation cannot separate model and
        # wrappers. The model's bytes, several times its size, are no longer needed.
        hello.mjb = hello.mjcf_compiled = hello.vfs_assets = None
        played = state.playing
        with state.mirror.lock:
            # Most likely the same play session goes on. If not, the first state of the new one shows it.
            keep = played and hello.manager_present and state.mirror.holds(loaded)
            if self._local_model:
                state.mirror.use(loaded, keep=keep)
            state.hello = hello
            state.objects.bind(hello, examined, keep=keep)
            if not keep:
                state.clocks.restart()
        state.located = False
        state.pending.play = state.pending.handshake = False
        views = state.objects.views()  # binds the cameras to the handshake's descriptions
        state.publishers.refresh()
        state.publishers.camera_switch.restart([view.info for view in views])
        if hello.manager_present and not played:
            state.publishers.events.publish(PlayStarted(articulations=list(state.objects.articulations)))
        if state.on_adopted is not None:
            state.on_adopted()
        state.tell_of_handshake()
        if hello.manager_present:
            await self._join(turn)
        else:
            state.mode.note(StepMode.LIVE)
        log.info(
            "session with %s, MuJoCo %s: %d articulations, mode %s",
            hello.urlab_version, hello.mujoco_version, len(state.objects.articulations), state.mode.current,
        )  # fmt: skip

    async def _join(self, turn: Turn) -> None:
        """Learn the state of the play session, and switch the server to the wanted step mode."""
        state, wanted = self._state, self._state.mode.wanted
        promoted = self._promote and wanted is not StepMode.AUTO
        if promoted:
            state.mode.unsettled = wanted  # until the server has accepted it, even if this call is cancelled
        else:
            state.mode.assume(StepMode.LIVE if wanted is StepMode.AUTO else wanted)
        await self._receive_state(turn)  # before a change of mode, because some servers publish in live mode only
        if promoted and await state.mode.promote(turn, wanted):
            state.located = False  # physics may have gone on until the change of mode

    async def _receive_state(self, turn: Turn) -> None:
        """Wait for a snapshot, because a handshake describes the model but not the simulation's state.

        `forward` would return the state, but make the server compute in a world that another program may be driving.
        """
        state = self._state
        # From the socket, where all are new: a region may still have one from before the server stopped publishing.
        source = state.publishers.state(StreamPolicy.ALL)
        snapshot = _FirstSnapshot()
        limit = _PUBLISHED_S if state.session.features.publishes_steps else _PERHAPS_S
        # If the caller has set a deadline, the rest of the handshake gets half of what is left.
        seconds = (turn.deadline(2 * limit) - asyncio.get_running_loop().time()) / 2
        try:
            source.attach(snapshot)
            await turn.aside(asyncio.wait((snapshot.came,), timeout=seconds))
        except ValueError as error:  # the server announces an invalid port
            log.info("the state stream cannot be received: %s", error)
        finally:
            source.detach(snapshot)
        state.publishers.check_open()
        if snapshot.came.done() and (found := snapshot.came.result()) is not None and state.matches(found):
            state.absorb_found(found, "state/full")


class _FirstSnapshot(MessageHandler):
    """Receives one snapshot.

    Attributes:
        came: The snapshot; None if there will be none.
    """

    def __init__(self) -> None:
        self.came: asyncio.Future[StateSnapshot | None] = asyncio.get_running_loop().create_future()

    def on_message(self, topic: bytes, payload: BytesLike) -> None:
        with contextlib.suppress(ProtocolError):
            self._settle(StateSnapshot.decode(payload))

    def on_malformed(self, problem: str) -> None:
        """Wait for the next one."""

    def on_refusal(self) -> None:
        """End the wait because nothing listens at the port."""
        self._settle(None)

    def on_end(self, error: Callable[[], URLabError]) -> None:
        self._settle(None)

    def _settle(self, found: StateSnapshot | None) -> None:
        if not self.came.done():
            self.came.set_result(found)


async def read_state(turn: Turn) -> ForwardOk | None:
    """Return the simulation's state, or None if play is not running or the server does not provide it."""
    try:
        return await turn.call(Forward())
    except (NoActiveManager, NotReady, UnknownOp):
        return None
