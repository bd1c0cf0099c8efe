"""Names: look-up by name or alias, which articulation a compiled name belongs to, and names of files. No I/O.

For the wrappers of both clients, whose maps of articulations, joints and so on are `NameMap`s, and for uploads.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeVar, overload

T = TypeVar("T")
D = TypeVar("D")

WINDOWS_DEVICES: Final = frozenset(
    ("CON", "PRN", "AUX", "NUL", *(f"{kind}{number}" for kind in ("COM", "LPT") for number in range(1, 10)))
)
"""Names that Windows keeps for devices, whatever follows their first dot."""

_LISTED = 20
# Unreal's actor names: class, then a number or a generated id.
_ENGINE_NAME: Final = re.compile(r"(?P<stem>.+)_C_(?:\d+|UAID_\w+)")
_NOT_A_NAME: Final = re.compile(r"[^A-Za-z0-9_]")
_MAX_FILE_NAME_BYTES: Final = 240


class UnknownName(KeyError):
    """A name that a `NameMap` does not have, or an alias of several of its entries.

    `args[0]` is the message, as `str()` gives it.

    Attributes:
        kind: What was looked for, for example `articulation`.
        name: The name that was asked for.
        matches: The keys an ambiguous alias could mean; empty otherwise.
        known: All keys, in the map's order.
        suggestions: Keys and aliases spelled alike, best first.
        owner: What it was looked for in, for example the key of an articulation; empty for the whole world.
    """

    kind: str
    name: object
    matches: tuple[str, ...]
    known: tuple[str, ...]
    suggestions: tuple[str, ...]
    owner: str

    def __init__(
        self,
        kind: str,
        name: object,
        matches: tuple[str, ...],
        known: tuple[str, ...],
        suggestions: tuple[str, ...],
        *,
        owner: str = "",
    ) -> None:
        self.kind = kind
        self.name = name
        self.matches = matches
        self.known = known
        self.suggestions = suggestions
        self.owner = owner
        super().__init__(self._message())

    def _message(self) -> str:
        if self.matches:
            what = f"{self.kind} {self.name!r}{f' of {self.owner}' if self.owner else ''}"
            return f"{what} is ambiguous: it could mean {_listed(self.matches, 'or')}."
        text = f"{f'{self.owner} has ' if self.owner else ''}no {self.kind} {self.name!r}."
        if self.suggestions:
            text += f" Did you mean {_listed(self.suggestions, 'or')}?"
        return f"{text} Known: {_listed(self.known, 'and')}." if self.known else f"{text} There are none."

    def __str__(self) -> str:
        return str(self.args[0])  # a plain KeyError puts it in quotes

    def __reduce__(self) -> tuple[Any, ...]:
        kind = partial(type(self), owner=self.owner)
        return kind, (self.kind, self.name, self.matches, self.known, self.suggestions)


def unknown_name(kind: str, name: object, known: Iterable[str], *, owner: str = "") -> UnknownName:
    """Return the exception for a name that is none of those, with the ones spelled alike."""
    names = tuple(known)
    close = difflib.get_close_matches(name, names) if isinstance(name, str) else []
    return UnknownName(kind, name, (), names, tuple(close), owner=owner)


def is_file_name(name: str) -> bool:
    """Return whether a name is that of a file on every system: no path, no device, not too long."""
    return (
        name not in ("", ".", "..")
        and not any(character in '/\\:*?"<>|' or ord(character) < ord(" ") for character in name)
        and len(name.encode()) <= _MAX_FILE_NAME_BYTES
        and name.partition(".")[0].rstrip(" ").upper() not in WINDOWS_DEVICES
    )


def cleaned_name(name: str) -> str:
    """Return a name as the beta makes it public: ASCII letters, digits and underscores, not beginning with a digit."""
    cleaned = _NOT_A_NAME.sub("_", name)
    return f"_{cleaned}" if cleaned[:1].isdigit() else cleaned


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a sentence, after a blank, that suggests the names spelled most alike; empty where none is."""
    close = difflib.get_close_matches(name, list(known))
    return f" Did you mean {_listed(close, 'or')}?" if close else ""


def _listed(names: Sequence[str], conjunction: str) -> str:
    shown = [repr(name) for name in names[:_LISTED]]
    if len(names) > _LISTED:
        return f"{', '.join(shown)} {conjunction} {len(names) - _LISTED} more"
    return f" {conjunction} ".join([", ".join(shown[:-1]), shown[-1]]) if len(shown) > 1 else shown[0]


class PublicDir:
    """Keeps private attributes out of `dir()`, from which consoles and editors complete."""

    __slots__ = ()

    def __dir__(self) -> list[str]:
        return [name for name in super().__dir__() if not name.startswith("_") or name.startswith("__")]


class Local(PublicDir):
    """Base class of what the async and the blocking client share: it reads and writes `_state`, and never waits."""

    __slots__ = ("__weakref__", "_state")

    _state: Any

    def __init__(self, state: object) -> None:
        self._state = state


_NESTED = {"articulation", "entity"}  # their descriptions are tables of tables


class NameMap(PublicDir, dict[str, T]):
    """A read-only dict of named things that also finds an entry by an alias, where the alias means one entry only.

    `map[name]`, `map.get(name)` and `name in map` agree: an exact key first, else an alias. Length, iteration, `keys`,
    `items` and comparison are those of a dict and know exact keys only. `copy()`, `|` and `dict(map)` make plain
    dicts, which can be changed.

    Args:
        items: The entries by exact key.
        aliases: Per alias the keys it stands for, for example a MJCF model name and its instances.
        kind: What the entries are, for messages.
        owner: What has them, for messages; empty for the whole world.

    Raises:
        ValueError: If an alias stands for a key that is not there.
    """

    kind: str
    """What the entries are."""
    owner: str
    """What has them; empty for the whole world."""

    def __init__(
        self,
        items: Mapping[str, T] | Iterable[tuple[str, T]] = (),
        aliases: Mapping[str, Sequence[str]] | None = None,
        kind: str = "entry",
        owner: str = "",
    ) -> None:
        super().__init__(items)
        self.kind = kind
        self.owner = owner
        self._aliases: dict[str, tuple[str, ...]] = {}
        for alias, keys in (aliases or {}).items():
            for key in keys:
                if not super().__contains__(key):
                    raise ValueError(f"alias {alias!r} stands for {key!r}, but no {kind} has that name")
            if keys and not super().__contains__(alias):
                self._aliases[alias] = tuple(dict.fromkeys(keys))

    @property
    def aliases(self) -> dict[str, tuple[str, ...]]:
        """The keys that each alias stands for; aliases that are also keys are left out."""
        return dict(self._aliases)

    def with_aliases(self) -> dict[str, T]:
        """Return the entries by key, then again by each alias that means one of them."""
        return {**self, **{alias: self[keys[0]] for alias, keys in self._aliases.items() if len(keys) == 1}}

    def over(self, entries: Mapping[str, D]) -> NameMap[D]:
        """Return a map of other entries for these keys, or some of them, which the same aliases mean."""
        known = {alias: keys for alias, keys in self._aliases.items() if entries.keys() >= {*keys}}
        return NameMap(entries, known, self.kind, self.owner)

    def key(self, name: str) -> str:
        """Return the key that `name` is or, as an alias, means.

        Raises:
            UnknownName: There is none, or more than one.
        """
        found = self._key(name)
        if found is None:
            raise self._unknown(name)
        return found

    def _key(self, name: object) -> str | None:
        """Return the key that `name` or its alias means, None when there is none or more than one."""
        if not isinstance(name, str):
            return None
        if super().__contains__(name):
            return name
        match self._aliases.get(name):
            case (key,):
                return key
            case _:
                return None

    def __missing__(self, name: str) -> T:
        return super().__getitem__(self.key(name))

    def __contains__(self, name: object) -> bool:
        return self._key(name) is not None

    @overload
    def get(self, key: str, default: None = None, /) -> T | None: ...
    @overload
    def get(self, key: str, default: T, /) -> T: ...
    @overload
    def get(self, key: str, default: D, /) -> T | D: ...
    def get(self, key: str, default: Any = None, /) -> Any:
        """Return the entry that `key` or its alias means, else `default`."""
        found = self._key(key)
        return default if found is None else super().__getitem__(found)

    def shortest(self) -> list[str]:
        """Return what each key is called for short: the shortest alias that means no other, or itself."""
        short = {key: key for key in self}
        for alias, keys in self._aliases.items():
            if len(keys) == 1 and len(alias) < len(short[keys[0]]):
                short[keys[0]] = alias
        return [*short.values()]

    def _unknown(self, name: object) -> UnknownName:
        known = tuple(self)
        spelled = name if isinstance(name, str) else ""
        matches = self._aliases.get(spelled, ())
        suggestions = difflib.get_close_matches(spelled, known) or difflib.get_close_matches(
            spelled, self.with_aliases()
        )
        return UnknownName(self.kind, name, matches, known, tuple(suggestions), owner=self.owner)

    def __reduce__(self) -> tuple[Any, ...]:
        return NameMap, (dict(self), self._aliases, self.kind, self.owner)

    def _ipython_key_completions_(self) -> list[str]:
        """Return what completes `map["` in IPython and Jupyter: keys, then the aliases that mean one of them."""
        return [*self.with_aliases()]

    def _repr_html_(self) -> str:
        from urlab_client.values.html import fields, table  # NumPy, which the command line loads late

        ways = [getattr(one, "describe", None) for one in self.values()]
        if self.kind in _NESTED or None in ways:
            return fields(self.kind, {name: repr(one) for name, one in self.items()})
        rows: list[dict[str, Any]] = [describe().to_dict() for describe in ways if describe is not None]
        heads = [*dict.fromkeys(head for row in rows for head in row)]
        return table([[row.get(head) for head in heads] for row in rows], heads=heads, caption=f"{self.kind}s")

    def _refuse(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError(f"this map of {self.kind} names is read-only; dict(map) makes a copy to change")

    if not TYPE_CHECKING:  # any call is refused, whatever the parameters of the overridden method
        __setitem__ = __delitem__ = __ior__ = update = setdefault = pop = popitem = clear = _refuse


def owner_of(name: str, prefixes: AbstractSet[str]) -> str | None:
    """Return the prefix that a compiled name `<prefix>_<local name>` carries, None when it carries none.

    The longest wins: `robot_2_elbow` belongs to `robot_2`, not to `robot`, when both exist. Only names are compared;
    a name that an unprefixed body happens to share with a prefix cannot be told apart here.
    """
    end = name.rfind("_", 0, len(name) - 1)
    while end > 0:
        if name[:end] in prefixes:
            return name[:end]
        end = name.rfind("_", 0, end)
    return None


def split_prefix(names: Iterable[str], prefixes: Collection[str]) -> list[tuple[str | None, str]]:
    """Split compiled names into owner and local name, as `owner_of` does for one.

    Args:
        names: Compiled names.
        prefixes: Articulation keys, without the trailing underscore.

    Returns:
        Per name, in order, the prefix and what follows its underscore; `(None, name)` for a name that carries none.
    """
    known = frozenset(prefixes)
    owned = ((owner_of(name, known), name) for name in names)
    return [(owner, name if owner is None else name[len(owner) + 1 :]) for owner, name in owned]


def robot_prefixes(robots: Iterable[tuple[str, str, str]]) -> NameMap[str]:
    """Return what the compiled names of robots' elements begin with, without the underscore, by the robots' keys.

    Aliases are what else users may call a robot: its actor id, what its compiled names begin with or, where that means
    no other robot, its class.

    Args:
        robots: Per robot its key, its actor id or "", and what its compiled names begin with.
    """
    prefixes: dict[str, str] = {}
    aliases: dict[str, list[str]] = {}
    classes: dict[str, list[str]] = {}
    for key, actor_id, prefix in robots:
        prefixes[key] = prefix
        for alias in {actor_id, prefix} - {""}:
            aliases.setdefault(alias, []).append(key)
        if found := _ENGINE_NAME.fullmatch(prefix):
            classes.setdefault(found["stem"], []).append(key)
    others = {stem: keys for stem, keys in classes.items() if stem not in aliases}
    return NameMap(prefixes, aliases | others, kind="articulation")


def lasting_names(prefixes: NameMap[str]) -> dict[str, str]:
    """Return the names of robots by key, for data that outlives the session, in which the engine numbers its actors.

    They are the keys, except for those that are names of the engine: instead of these the actor id or, without one, the
    class, where that means no other robot.

    Args:
        prefixes: As from `robot_prefixes`.
    """
    names: dict[str, str] = {}
    for alias, (key, *others) in prefixes.aliases.items():
        if prefixes[key] == key and not others:
            names.setdefault(key, alias)
    return {key: names.get(key, key) for key in prefixes}


def spellings(names: Sequence[str], prefixes: NameMap[str]) -> list[tuple[str, ...]]:
    """Return what users may write for the elements of a compiled model.

    Args:
        names: Compiled names.
        prefixes: As from `robot_prefixes`.

    Returns:
        Per name, in order, the name itself, then `ROBOT/NAME` and `ROBOT_NAME` by every name that means the robot.
        Where an element belongs to none, any underscore may be written as the slash.
    """
    called: dict[str, list[str]] = {prefix: [prefix] for prefix in prefixes.values()}
    for robot, prefix in prefixes.with_aliases().items():
        called[prefix].append(robot)
    found: list[tuple[str, ...]] = []
    for name, (owner, local) in zip(names, split_prefix(names, called), strict=True):
        if owner is None:
            cuts = (i for i, character in enumerate(name) if character == "_")
            others = [f"{name[:i]}/{name[i + 1 :]}" for i in cuts]
        else:
            others = [f"{robot}{between}{local}" for between in "/_" for robot in called[owner]]
        found.append(tuple(dict.fromkeys((name, *others))))
    return found


def own_aliases(names: Sequence[str], prefix: str, prefixes: NameMap[str]) -> dict[str, list[str]]:
    """Return what else users may write for the elements of one robot, each with the name that means it.

    Args:
        names: What the robot itself calls its elements.
        prefix: What its compiled names begin with.
        prefixes: As from `robot_prefixes`.
    """
    compiled = [f"{prefix}_{name}" for name in names]
    written = _meanings(zip(names, spellings(compiled, prefixes), strict=True))
    return written | {other: [name] for other, name in zip(compiled, names, strict=True)}


def element_ids(names: Sequence[str], prefixes: NameMap[str], kind: str) -> NameMap[int]:
    """Return the ids of the named elements of one kind by compiled name.

    Aliases are their other `spellings`, and what a robot itself calls its element: `NAME`.
    """
    written, owned = spellings(names, prefixes), split_prefix(names, [*prefixes.values()])
    aliases = _meanings(
        (name, (*others, local)) for (name, *others), (_, local) in zip(written, owned, strict=True) if name
    )
    return NameMap({name: i for i, name in enumerate(names) if name}, aliases, kind)


def _meanings(written: Iterable[tuple[str, Iterable[str]]]) -> dict[str, list[str]]:
    """Return the names that each spelling may mean, given the spellings of each name."""
    found: dict[str, list[str]] = {}
    for name, others in written:
        for other in others:
            found.setdefault(other, []).append(name)
    return found
