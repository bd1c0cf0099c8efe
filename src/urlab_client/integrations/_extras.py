"""A clear word when an extra is not installed."""

from __future__ import annotations

import importlib.util

__all__ = ["need"]


def need(*modules: str, extra: str) -> None:
    """Check that modules can be imported.

    Raises:
        ImportError: One is missing; names the extra that brings it.
    """
    for name in modules:
        if importlib.util.find_spec(name) is None:
            raise ImportError(f"{name} is not installed; run: pip install 'urlab-client[{extra}]'", name=name)
