"""What a server can do, according to its replies. No I/O.

Versions of the plugin gained features gradually, and their version strings are unreliable. So nothing compares
versions: `Features` is derived from `meta`, the handshake and the shape of replies, and all other code tests its flags.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from urlab_client.protocol.messages.runtime import ClaimControlOk
from urlab_client.protocol.messages.session import HelloOk, StateReply
from urlab_client.values.plain import Serializable


class Features(Serializable, Struct, frozen=True, kw_only=True, dict=True):
    """What a server can do.

    Attributes:
        ops: Ops that it lists; None if it was not asked or has no list, which is treated as an alpha.
        capabilities: Capabilities that its instance reports; the absence of one proves nothing.
        arts: Whether replies name the robots' states `arts`, as the beta does; None before the first reply.
        reads_owner: Whether it reads `control_owner`, instead of taking the session as the owner; None before the first
            claim.
    """

    ops: frozenset[str] | None = None
    capabilities: frozenset[str] = frozenset()
    arts: bool | None = None
    reads_owner: bool | None = None

    # Updates from replies. A new session keeps the features: it is the same server until its replies differ.

    def with_ops(self, names: Iterable[str] | None) -> Features:
        """Return the features after a reply to `meta`; None for a server without that op."""
        return replace(self, ops=None if names is None else frozenset(names))

    def with_hello(self, hello: HelloOk) -> Features:
        """Return the features after a handshake."""
        # Before play there is no instance, so nothing follows from that.
        if hello.instance is None:
            return self
        return replace(self, capabilities=frozenset(hello.instance.capabilities))

    def with_reply(self, reply: StateReply) -> Features:
        """Return the features after a reply that contains state."""
        arts = reply.arts is not None
        return self if arts is self.arts else replace(self, arts=arts)

    def with_claim(self, sent: str, reply: ClaimControlOk) -> Features:
        """Return the features after a claim with `sent` as the owner."""
        return replace(self, reads_owner=reply.owner == sent)

    # Derived flags. Cached, because some are read in every step.

    def offers(self, op: str) -> bool:
        """Whether the server lists an op; a server without a list may have any."""
        return self.ops is None or op in self.ops

    def _lists(self, op: str) -> bool:
        return self.ops is not None and op in self.ops

    @cached_property
    def claims(self) -> bool:
        """Robots have an owner, and others' writes are refused."""
        return self._lists("claim_control")

    @cached_property
    def jobs(self) -> bool:
        """Some editor ops answer `op_started`, and `op_status` delivers their replies."""
        return self._lists("op_status")

    @cached_property
    def remove_op(self) -> Literal["destroy_actor", "remove_actor"]:
        """Name of the op that removes an actor."""
        return "remove_actor" if self._lists("remove_actor") else "destroy_actor"

    @cached_property
    def camera_switch(self) -> bool:
        """Cameras stream only after `set_camera_streaming`."""
        return self._lists("set_camera_streaming")

    @cached_property
    def uploads(self) -> bool:
        """Models can be uploaded."""
        return self._lists("upload_model_manifest")

    @cached_property
    def leases(self) -> bool:
        """Clients can tell each other who uses the server."""
        return self._lists("acquire_lease")

    @cached_property
    def user_channels(self) -> bool:
        """Levels can declare values of their own that clients write and read."""
        return self._lists("set_user_channels")

    @cached_property
    def renders_sync(self) -> bool:
        """`render: "sync"` makes a step wait for pictures of its own state."""
        return "render_sync" in self.capabilities

    @cached_property
    def _beta_state(self) -> bool:
        # The encoder that says `arts` is the one that publishes in live mode only, and no rows.
        return self.claims if self.arts is None else self.arts

    @cached_property
    def live_pictures_in_steps(self) -> bool:
        """A step in live mode may bring pictures, too, and applies all commands."""
        return self._beta_state

    @cached_property
    def publishes_steps(self) -> bool:
        """State is published outside live mode, too."""
        return not self._beta_state

    @cached_property
    def publishes_rows(self) -> bool:
        """Single joints, sensors and so on are published as rows."""
        return not self._beta_state

    @cached_property
    def exact_controls(self) -> bool:
        """Set-points and what controllers make of them are not rounded to single precision."""
        return self._beta_state

    @cached_property
    def idles_in_puppet(self) -> bool:
        """Physics takes steps of its own between the pushes of puppet mode, unless it is paused."""
        return self._beta_state

    @cached_property
    def generation(self) -> str:
        """For people: `alpha`, `june`, `beta`, `3`, or empty before anything is known. Nothing depends on it."""
        if self.ops is None:
            return ""
        if self.claims:
            return "beta" if self._lists("set_control_source") else "3"
        return "june" if self.camera_switch else "alpha"
