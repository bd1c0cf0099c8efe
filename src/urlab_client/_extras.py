"""A clear error for a missing extra."""

from __future__ import annotations

import importlib.util

from urlab_client._installation import install_command


class MissingExtra(ImportError):
    """An optional library is not installed; the message gives the command that installs its extra."""


def need(*modules: str, extra: str) -> None:
    """Check that modules can be imported.

    Raises:
        MissingExtra: A module is missing.
    """
    for name in modules:
        if importlib.util.find_spec(name) is None:
            raise MissingExtra(f"{name} is not installed; run: {install_command(extra)}", name=name)
