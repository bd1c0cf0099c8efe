"""Controllers: the server-side loops that turn set-points into actuator signals."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, cast

from urlab_client.aio.defaults import DEFAULT, Timeout
from urlab_client.enums import ControllerKind, known
from urlab_client.errors import ControllerSchemaViolation, ProtocolError
from urlab_client.protocol.messages.runtime import ConfigureController
from urlab_client.protocol.messages.session import ControllerInfo
from urlab_client.values.names import PublicDir

if TYPE_CHECKING:
    from urlab_client.aio.session.session import Session
    from urlab_client.aio.session.turn import Turn

_GAINS = ("kp", "kv", "torque_limit")


class URLabController(PublicDir):
    """The controller attached to an articulation."""

    def __init__(self, session: Session, prefix: str, info: ControllerInfo) -> None:
        self._session = session
        self._prefix = prefix
        self._info = info

    @property
    def articulation_prefix(self) -> str:
        """Key of the articulation that it drives."""
        return self._prefix

    @property
    def kind(self) -> ControllerKind | str:
        """`pd`, `passthrough`, or a plain string for a kind that this client does not know."""
        return known(ControllerKind, self._info.kind)

    @property
    def params(self) -> Mapping[str, Any]:
        """Parameters that the server acknowledged last; a read-only view that stays current."""
        return MappingProxyType(self._info.params)

    @property
    def schema(self) -> Mapping[str, Any]:
        """Parameter name to `{type, dtype, min}`."""
        return MappingProxyType(self._info.schema)

    async def configure(self, *, timeout: Timeout = DEFAULT, **params: Any) -> dict[str, Any]:
        """Check parameters against the schema, push them, and return all parameters in force.

        Args:
            timeout: Seconds to wait; None waits without limit.
            **params: Parameters to change; a mapping changes only the actuators that it names.

        Raises:
            ControllerSchemaViolation: A parameter does not fit the schema; nothing was sent.
        """
        _check_params(self._prefix, self._info.schema, self._info.params, params)
        return await self._push(dict(params), timeout)

    async def refresh(self, *, timeout: Timeout = DEFAULT) -> dict[str, Any]:
        """Pull the parameters from the server again and return them."""
        return await self._push({}, timeout)

    async def _push(self, params: dict[str, Any], timeout: Timeout) -> dict[str, Any]:
        async with self._session.turn(ConfigureController, timeout=timeout) as turn:
            await self._exchange(params, turn)
            return dict(self._info.params)

    async def _exchange(self, params: dict[str, Any], turn: Turn) -> None:
        with self._session.settling(f"controller of {self._prefix!r}", partial(self._exchange, {})):
            reply = await turn.call(ConfigureController(articulation=self._prefix, params=params))
        _check_gains(self._prefix, self._info.kind, reply.params, "configure_controller")
        # In place, so that views handed out before stay current.
        self._info.params.clear()
        self._info.params.update(reply.params)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.kind} of {self._prefix!r}>"


class URLabPDController(URLabController):
    """A PD controller: torque = kp (set-point - position) - kv velocity, clamped to the torque limit.

    Gains are keyed by short actuator name. A torque limit of 0 means no torque.
    """

    @property
    def kp(self) -> Mapping[str, float]:
        """Position gain per actuator, N m/rad or N/m; a live read-only view."""
        return _View(self._info.params, "kp")

    @property
    def kv(self) -> Mapping[str, float]:
        """Velocity gain per actuator, N m s/rad or N s/m; a live read-only view."""
        return _View(self._info.params, "kv")

    @property
    def torque_limit(self) -> Mapping[str, float]:
        """Largest output per actuator, N m or N; a live read-only view."""
        return _View(self._info.params, "torque_limit")

    async def set_gains(
        self,
        kp: Mapping[str, float] | None = None,
        kv: Mapping[str, float] | None = None,
        torque_limit: Mapping[str, float] | None = None,
        *,
        timeout: Timeout = DEFAULT,
    ) -> dict[str, Any]:
        """Change gains of the named actuators and return all parameters in force. Others keep their gains.

        Raises:
            ControllerSchemaViolation: An unknown actuator or a value below the minimum; nothing was sent.
        """
        gains = {"kp": kp, "kv": kv, "torque_limit": torque_limit}
        return await self.configure(timeout=timeout, **{name: dict(v) for name, v in gains.items() if v is not None})

    async def set_defaults(
        self,
        kp: float | None = None,
        kv: float | None = None,
        torque_limit: float | None = None,
        *,
        timeout: Timeout = DEFAULT,
    ) -> dict[str, Any]:
        """Change the default gains, apply them to every actuator, and return all parameters in force.

        Raises:
            ControllerSchemaViolation: A value is below the minimum; nothing was sent.
        """
        given = {"kp": kp, "kv": kv, "torque_limit": torque_limit}
        params: dict[str, Any] = {}
        for name, value in given.items():
            if value is not None:
                params[f"default_{name}"] = value
                # The server changes only the default; actuators keep the gains that they were bound with.
                params[name] = dict.fromkeys(self._info.params.get(name, {}), value)
        return await self.configure(timeout=timeout, **params)


class _View(Mapping[str, float]):
    """Live view of one per-actuator parameter."""

    __slots__ = ("_name", "_params")

    def __init__(self, params: dict[str, Any], name: str) -> None:
        self._params = params
        self._name = name

    def __getitem__(self, key: str) -> float:
        return self._params[self._name][key]

    def __iter__(self) -> Any:
        return iter(self._params.get(self._name, {}))

    def __len__(self) -> int:
        return len(self._params.get(self._name, {}))

    def __repr__(self) -> str:
        return repr(dict(self))


def make_controller(session: Session, prefix: str, info: ControllerInfo) -> URLabController:
    """Return the wrapper for a handshake's controller block, which it reflects."""
    return (URLabPDController if info.kind == ControllerKind.PD else URLabController)(session, prefix, info)


def check_controller(prefix: str, info: ControllerInfo) -> None:
    """Check a handshake's controller block.

    Raises:
        ProtocolError: Gains of a PD controller are not numbers by actuator, or a minimum is not a number.
    """
    _check_gains(prefix, info.kind, info.params, "hello")
    for name, rule in info.schema.items():
        low = rule.get("min")
        if low is not None and not _is_number(low):
            raise ProtocolError(
                f"hello: the minimum of {name} of the controller of {prefix!r} is {low!r}, not a number.", op="hello"
            )


def _check_gains(prefix: str, kind: str, params: Mapping[str, Any], op: str) -> None:
    for name in _GAINS if kind == ControllerKind.PD else ():
        gains = params.get(name, {})
        if not (isinstance(gains, dict) and all(map(_is_number, cast("dict[str, Any]", gains).values()))):
            raise ProtocolError(
                f"{op}: {name} of the controller of {prefix!r} is {gains!r:.60}, not numbers by actuator.", op=op
            )


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _check_params(
    prefix: str, schema: Mapping[str, Any], current: Mapping[str, Any], params: Mapping[str, Any]
) -> None:
    """Refuse parameters that do not fit the schema; the plugin would ignore them silently.

    Raises:
        ControllerSchemaViolation: A parameter does not fit the schema.
    """
    for name, value in params.items():
        rule = schema.get(name)
        if rule is None:
            raise _violation(prefix, f"no parameter is called {name!r}; available: {', '.join(schema) or 'none'}")
        if rule.get("type") == "per_joint":
            if not isinstance(value, Mapping):
                raise _violation(prefix, f"{name} takes a mapping of actuator name to number, got {value!r}")
            for actuator, number in cast("Mapping[str, Any]", value).items():
                if actuator not in current.get(name, {}):
                    raise _violation(
                        prefix, f"{name}: no actuator {actuator!r}; available: {', '.join(current.get(name, {}))}"
                    )
                _check_number(prefix, f"{name}[{actuator!r}]", number, rule)
        else:
            _check_number(prefix, name, value, rule)


def _check_number(prefix: str, what: str, value: Any, rule: Mapping[str, Any]) -> None:
    if not _is_number(value):
        raise _violation(prefix, f"{what} takes a number, got {value!r}")
    low = rule.get("min")
    if low is not None and not value >= low:
        raise _violation(prefix, f"{what} must be at least {low:g}, got {value!r}")
    if math.isnan(value):
        raise _violation(prefix, f"{what} takes a number, got {value!r}")


def _violation(prefix: str, problem: str) -> ControllerSchemaViolation:
    return ControllerSchemaViolation(
        "controller_schema_violation", f"{prefix}: {problem}. Nothing was sent.", op="configure_controller"
    )
