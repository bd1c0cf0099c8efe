"""The installation of this package: extras that are missing, the command that adds one, and conflicts with others.

Two distributions that both contain a top-level `urlab_client` overwrite each other's files, and neither works.
Searching all installed distributions is slow, so only `urlab doctor` does it, and the handling of failed imports.
"""

import importlib.util
import json
import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from typing import Any
from urllib.parse import urlsplit

_PACKAGE = "urlab_client"
_OWN = "urlab-client"


def conflict() -> str | None:
    """Return which other distributions contain a package `urlab_client`, and what to do; None if none does."""
    others = sorted({name for name in packages_distributions().get(_PACKAGE, ()) if _normalized(name) != _OWN})
    if not others:
        return None
    return (
        f"{' and '.join(others)} also installs a package {_PACKAGE}, and the two overwrite each other's files. "
        f"Keep one per environment: pip uninstall -y {' '.join(others)} {_OWN}, then install the one you want."
    )


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this environment.

    An installation from a folder uses that folder again, any other the package index.
    """
    command = f"{shlex.quote(sys.executable)} -m pip install"
    if importlib.util.find_spec("pip") is None:  # as in environments created by uv
        command = f"uv pip install --python {shlex.quote(sys.executable)}"
    return f"{command} {_source(extra)}"


def _source(extra: str) -> str:
    """Return the requirement for the installer, quoted for a shell."""
    try:
        recorded: dict[str, Any] = json.loads(distribution(_OWN).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        recorded = {}
    if "dir_info" not in recorded:  # PEP 610: installed from a folder
        return shlex.quote(f"{_OWN}[{extra}]")
    url: str = recorded["url"]
    from urllib.request import url2pathname  # would import HTTP and e-mail at every server start

    folder = url2pathname(urlsplit(url).path)
    editable = "-e " if recorded["dir_info"].get("editable") else ""
    return f"{editable}{shlex.quote(f'{folder}[{extra}]')}"


def _normalized(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")


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
