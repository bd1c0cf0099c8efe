"""Values as HTML, which notebooks show instead of the repr: tables, pictures and curves. No I/O."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

_ROWS: Final = 50
_OPEN_ROWS: Final = 12
_NUMBERS: Final = 7
_CHARACTERS: Final = 300
_SMALLEST_RANGE: Final = 1e-6
_NOISE: Final = 1e-9
_WIDTH: Final = 240
_HEIGHT: Final = 32
_LEFT: Final = ' style="text-align: left"'


class Markup(str):
    """Text that is HTML already. All other text is escaped."""

    __slots__ = ()


def table(rows: Iterable[Sequence[object]], *, heads: Sequence[str] = (), caption: str = "") -> Markup:
    """Return a table.

    Args:
        rows: The cells of each row: text, numbers, arrays, mappings, which become tables of their own, or `Markup`.
        heads: Titles of the columns; empty for none.
        caption: Text above the table; empty for none.
    """
    lines = list(rows)
    parts = [f"<caption{_LEFT}>{html.escape(caption)}</caption>"] if caption else []
    if heads:
        parts.append(f"<tr>{''.join(f'<th{_LEFT}>{html.escape(head)}</th>' for head in heads)}</tr>")
    for line in lines[:_ROWS]:
        parts.append(f"<tr>{''.join(f'<td{_LEFT}>{_cell(value)}</td>' for value in line)}</tr>")  # noqa: PERF401
    if len(lines) > _ROWS:
        parts.append(f"<tr><td>… {len(lines) - _ROWS} more</td></tr>")
    return Markup(f"<table>{''.join(parts)}</table>")


def fields(caption: str, values: Mapping[str, Any]) -> Markup:
    """Return a table with a row per entry that has a value.

    Args:
        caption: Text above the table; empty for none.
        values: Values by name, as in the rows of `table`.
    """
    rows = [(bold(name), value) for name, value in values.items() if not _is_empty(value)]
    return table(rows, caption=caption)


def bold(text: str, colour: str = "inherit") -> Markup:
    """Return text in bold type and a CSS colour."""
    return Markup(f'<b style="color: {colour}">{html.escape(text)}</b>')


def picture(data: bytes, kind: str, description: str) -> Markup:
    """Return an encoded picture, which takes its place in the page without a file.

    Args:
        data: Bytes of the file.
        kind: `png` or `jpeg`.
        description: Text for those who cannot see it.
    """
    encoded = base64.b64encode(data).decode("ascii")
    return Markup(f'<img alt="{html.escape(description)}" src="data:image/{kind};base64,{encoded}">')


def curve(values: ArrayLike) -> Markup:
    """Return a small curve of evenly spaced values, shape (n,). Rounding noise is a straight line."""
    line = np.nan_to_num(np.asarray(values, np.float64))
    if line.size < 2:
        return Markup("")
    low, high = float(line.min()), float(line.max())
    span = max(high - low, _SMALLEST_RANGE * max(1.0, abs(low), abs(high)))
    heights = _HEIGHT - 2 - (line - (low + high - span) / 2) / span * (_HEIGHT - 4)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(np.linspace(1, _WIDTH - 1, line.size), heights, strict=True))
    return Markup(
        f'<svg width="{_WIDTH}" height="{_HEIGHT}" role="img" aria-label="from {low:.4g} to {high:.4g}">'
        f'<polyline points="{points}" fill="none" stroke="currentColor"/></svg>'
    )


def number(value: float) -> str:
    """Return a number with four digits; what is as small as rounding noise is 0."""
    return "0" if abs(value) < _NOISE else f"{value:.4g}"


def _is_empty(value: object) -> bool:
    return value is None or (isinstance(value, str | bytes | Mapping | list | tuple) and not value)


def _cell(value: object) -> str:  # noqa: PLR0911 - one for each kind of value
    match value:
        case Markup():
            return value
        case Mapping():
            return _mapping(cast("Mapping[str, Any]", value))
        case list() | tuple() if value and all(isinstance(one, Mapping) for one in cast("list[Any]", value)):
            return _folded([("", one) for one in cast("list[Mapping[str, Any]]", value)])
        case list() | tuple() | np.ndarray():
            return _numbers(cast("Sequence[Any]", value))
        case float() | np.floating():
            return number(float(value))
        case bytes():
            return f"{len(value)} bytes"
        case _:
            text = "" if value is None else str(value)
            return html.escape(text if len(text) <= _CHARACTERS else f"{text[:_CHARACTERS]}…")


def _mapping(values: Mapping[str, Any]) -> str:
    if set(values) == {"sec", "nsec"}:
        return f"{values['sec'] + values['nsec'] / 1e9:.3f} s"
    if values and all(isinstance(one, Mapping) for one in values.values()):
        return _folded(list(values.items()))
    return fields("", values)


def _folded(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Return mappings as the rows of a table, which is folded up if it is long."""
    heads = list(dict.fromkeys(key for _, row in rows for key, value in row.items() if not _is_empty(value)))
    named = any(name for name, _ in rows)
    lines = [[*([bold(name)] if named else []), *(row.get(head) for head in heads)] for name, row in rows]
    found = table(lines, heads=["", *heads] if named else heads)
    opened = " open" if len(rows) <= _OPEN_ROWS else ""
    return f"<details{opened}><summary>{len(rows)}</summary>{found}</details>"


def _numbers(values: Sequence[Any]) -> str:
    """Return the first few of several values, and how many there are."""
    flat: list[object] = np.ravel(np.asarray(values, dtype=object)).tolist()
    listed = ", ".join(_cell(one) for one in flat[:_NUMBERS])
    shape = " by ".join(map(str, np.shape(values)))
    shown = f"[{listed}]" if len(flat) <= _NUMBERS else f"[{listed}, …] ({shape})"
    return f'<span style="white-space: nowrap">{shown}</span>'
