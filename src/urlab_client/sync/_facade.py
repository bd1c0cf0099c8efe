"""The base classes of the generated façade, whose blocking objects wrap asynchronous ones.

All blocking-only code is in the modules of `urlab_client.sync` whose names start with an underscore; the others are
generated and contain no behaviour.
"""

from __future__ import annotations

import inspect
import warnings
from typing import Any, Protocol, TypeVar, cast, overload

from urlab_client.sync._portal import Portal
from urlab_client.values.names import Local, NameMap

A_co = TypeVar("A_co", covariant=True)
F = TypeVar("F", bound=Local)

_FACADES: dict[type, type[Facade]] = {}


class Facade(Local):
    """Base of the generated classes: the blocking twin of one asynchronous object.

    A subclass names the class that it wraps: `class Scene(Facade, twin=aio.Scene)`. Only `wrap` creates instances. What
    both twins inherit from another `Local` reads the same state.
    """

    __slots__ = ("_aio", "_maps", "_portal")

    _aio: Any
    _maps: dict[str, tuple[NameMap[Any], NameMap[Any]]]
    _portal: Portal

    def __init_subclass__(cls, *, twin: type | None = None, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if twin is not None:
            _FACADES[twin] = cls

    def __init__(self, aio: object, portal: Portal) -> None:
        super().__init__(getattr(aio, "_state", None))
        self._aio = aio
        self._portal = portal
        self._maps = {}

    # None is also an object; the first match wins.
    @overload
    def _wrap(self, cls: type[F], aio: None) -> None: ...  # type: ignore[overload-overlap]  # pyright: ignore[reportOverlappingOverload]
    @overload
    def _wrap(self, cls: type[F], aio: object) -> F: ...
    def _wrap(self, cls: type[F], aio: object) -> F | None:
        """Return the façade twin of `aio`, an object of the same client; None for None."""
        return None if aio is None else wrap(self._portal, cls, aio)

    def _map(self, name: str, cls: type[F], source: NameMap[Any]) -> NameMap[F]:
        """Return the twins of the entries of `source`; the same map while property `name` has this `source`.

        Cached here, not in the map: the loop's tasks keep `source` alive, which must not keep the twins alive.
        """
        known, twins = self._maps.get(name, (None, None))
        if twins is None or known is not source:
            entries = cast("NameMap[object]", source).items()
            twins = NameMap({key: self._wrap(cls, entry) for key, entry in entries}, source.aliases, source.kind)
            self._maps[name] = source, twins
        return twins

    def __repr__(self) -> str:
        if type(self._aio).__repr__ is object.__repr__:
            return super().__repr__()
        return repr(self._aio)

    def _repr_html_(self) -> str | None:
        shown = getattr(self._aio, "_repr_html_", None)
        return None if shown is None else shown()

    def __reduce__(self) -> tuple[Any, ...]:
        raise TypeError(
            f"{type(self).__name__} cannot be pickled or copied: its connection belongs to this process. "
            "Create a client in the process that needs one."
        )


def wrap(portal: Portal, cls: type[F], aio: object) -> F:
    """Return the façade twin of `aio`, always the same object; `aio` itself if both clients share its class.

    Args:
        portal: Portal to the loop of `aio`.
        cls: Declared type of the twin, for type checkers.
        aio: The object of the async client.
    """
    facade = next((_FACADES[base] for base in type(aio).__mro__ if base in _FACADES), None)
    if facade is None:
        return cast("F", aio)

    def make() -> Facade:
        twin = object.__new__(facade)
        Facade.__init__(twin, aio, portal)
        return twin

    return cast("F", portal.twin(aio, make))


class _Twin(Protocol[A_co]):
    @property
    def _aio(self) -> A_co: ...


def aio_of(twin: _Twin[A_co]) -> A_co:
    """Return the async object that a façade object wraps."""
    return twin._aio  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]


def portal_of(twin: Facade) -> Portal:
    """Return the portal to the event loop of a façade object's client."""
    return twin._portal  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]


class FacadeRoot(Facade):
    """Base of a generated class that users construct: owns the portal."""

    __slots__ = ("_opened_at",)

    def __init__(self, aio: Any) -> None:
        super().__init__(aio, Portal(aio.close))
        self._portal.twin(aio, lambda: self)
        self._opened_at = _first_line_outside_package()

    def __del__(self) -> None:
        portal: Portal | None = getattr(self, "_portal", None)  # None if the constructor failed.
        if portal is not None and portal.is_open:
            file, line = self._opened_at
            message = f"unclosed {self!r}, opened at {file}:{line}; use `with` or call close()"
            warnings.warn_explicit(message, ResourceWarning, file, line)


def _first_line_outside_package() -> tuple[str, int]:
    package = __name__.partition(".")[0]
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == package:
        frame = frame.f_back
    return (frame.f_code.co_filename, frame.f_lineno) if frame is not None else ("<unknown>", 0)
