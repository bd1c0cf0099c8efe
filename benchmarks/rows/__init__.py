"""The rows of the table, by subject: each module here has `ROWS`, a tuple of `Row`."""

from __future__ import annotations

import importlib
import pkgutil

from benchmarks.harness import Row

__all__ = ["all_rows"]


def all_rows() -> list[Row]:
    """Return the rows of all modules of this package, in the order of module names."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    return [row for name in names for row in importlib.import_module(f"{__name__}.{name}").ROWS]
