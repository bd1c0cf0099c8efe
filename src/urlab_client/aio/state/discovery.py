"""Turning a handshake into the client's state: the session, the local model, the scene and the step mode."""

from __future__ import annotations

import logging
import warnings
from functools import partial

import anyio.to_thread

from urlab_client.aio.session import Turn
from urlab_client.aio.state.handshake import examine
from urlab_client.aio.state.sim_state import SimState
from urlab_client.aio.state.step_mode import promote
from urlab_client.protocol.codec import decode_reply, op_of
from urlab_client.protocol.enums import StepMode
from urlab_client.protocol.errors import NoActiveManager, NotReady, UnknownOp, URLabError, URLabVersionMismatch
from urlab_client.protocol.messages.session import NOT_SENT, Forward, ForwardOk, Hello, HelloOk, Meta
from urlab_client.protocol.messages.streams import PlayStarted

__all__ = ["Discovery", "look"]

log: logging.Logger = logging.getLogger("urlab_client.client")


class Discovery:
    """Opens sessions and applies handshakes.

    Args:
        state: State of the client, updated from each handshake.
        local_model: Whether to load the model of the handshake.
        check_version: Whether to raise an error if the MuJoCo builds differ.
        promote: Whether to switch the server to the step mode that the client was created with.
        trusted: Whether to load models in MuJoCo's binary format.
    """

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
        hello = await state.session.hello(turn, Hello(observations=observations))
        state.level = state.sent_level = observations
        await self.adopt(turn, hello)
        return hello

    async def look_on(self, turn: Turn, handshake: bytes) -> None:
        """Apply the result of another client's `handshake()` without opening a session.

        Raises:
            ValueError: `handshake` is not the result of `handshake()`.
        """
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
        state.sent_level = state.level
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
        played = state.hello is not None and state.hello.manager_present
        with state.mirror.lock:
            if self._local_model:
                state.mirror.use(loaded)
            state.hello = hello
            state.objects.bind(hello, examined)
            state.forget_clocks()
        state.pending.play = False
        views = state.objects.views()  # binds the cameras to the handshake's descriptions
        state.publishers.refresh()
        if state.publishers.camera_switch is not None:
            state.publishers.camera_switch.restart([view.info for view in views])
        if hello.manager_present and not played:
            state.publishers.events.publish(PlayStarted(articulations=list(state.objects.articulations)))
        if state.on_adopted is not None:
            state.on_adopted()
        state.tell_of_handshake()
        if not hello.manager_present:
            state.mode = StepMode.LIVE
        elif self._promote and state.wanted_mode is not StepMode.AUTO:
            await promote(state, turn, state.wanted_mode)
        else:
            state.assume_mode(StepMode.LIVE if state.wanted_mode is StepMode.AUTO else state.wanted_mode)
        # A handshake describes the model but not the simulation's state, which may have run for hours.
        if hello.manager_present and not state.session.read_only and (reply := await look(turn)) is not None:
            state.absorb_found(reply, "forward")
        log.info(
            "session with %s, MuJoCo %s: %d articulations, mode %s",
            hello.urlab_version, hello.mujoco_version, len(state.objects.articulations), state.mode,
        )  # fmt: skip


async def look(turn: Turn) -> ForwardOk | None:
    """Return the simulation's state, or None if play is not running or the server does not provide it."""
    try:
        return await turn.call(Forward())
    except (NoActiveManager, NotReady, UnknownOp):
        return None
