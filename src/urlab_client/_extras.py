"""A clear word when an extra is not installed."""

from __future__ import annotations

import importlib.util

from urlab_client._installation import install_command

__all__ = ["MissingExtra", "need"]


class MissingExtra(ImportError):
    """An optional library is not installed; the text names the extra that brings it."""


def need(*modules: str, extra: str) -> None:
    """Check that modules can be imported.

    Raises:
        MissingExtra: One is missing.
    """
    for name in modules:
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(f"{name} is not installed; run: {install_command(extra)}", name=name)
