"""The rows of the table, by subject: each module here has `ROWS`, a tuple of `Row`."""

from __future__ import annotations

import importlib
import pkgutil

from benchmarks.harness import Row

__all__ = ["all_rows", "one_row"]


def all_rows() -> list[Row]:
    """Return the rows of all modules of this package, in the order of module names."""
    return [row for name in _modules() for row in importlib.import_module(f"{__name__}.{name}").ROWS]


def one_row(wanted: str) -> Row | None:
    """Return the row of a name. Modules that do not fit the installed package, maybe an older one, have none."""
    for name in _modules():
        try:
            rows = importlib.import_module(f"{__name__}.{name}").ROWS
        except ImportError:
            continue
        for row in rows:
            if row.name == wanted:
                return row
    return None


def _modules() -> list[str]:
    return sorted(module.name for module in pkgutil.iter_modules(__path__))
