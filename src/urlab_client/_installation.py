"""How this package was installed: what adds an extra to it, and whether another package overwrites it.

Two distributions that both bring a top-level `urlab_client` write over each other's files, and what is left is neither.
Looking through all installed distributions takes a while, so it is done by `urlab doctor`, and when an import has
failed.
"""

import importlib.util
import json
import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from typing import Any
from urllib.parse import urlsplit

__all__ = ["conflict", "install_command"]

_PACKAGE = "urlab_client"
_OWN = "urlab-client"


def conflict() -> str | None:
    """Say which other distributions bring a package `urlab_client`, and what to do; None if there are none."""
    others = sorted({name for name in packages_distributions().get(_PACKAGE, ()) if _normalized(name) != _OWN})
    if not others:
        return None
    return (
        f"{' and '.join(others)} installs a package {_PACKAGE}, too, and the two overwrite each other's files. "
        f"Keep one per environment: pip uninstall -y {' '.join(others)} {_OWN}, then install the one you want."
    )


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this environment.

    A clone is installed from its folder, as it was before; anything else from the index.
    """
    command = f"{shlex.quote(sys.executable)} -m pip install"
    if importlib.util.find_spec("pip") is None:  # environments of uv have none
        command = f"uv pip install --python {shlex.quote(sys.executable)}"
    return f"{command} {_source(extra)}"


def _source(extra: str) -> str:
    """Return what to name to the installer, quoted for a shell."""
    try:
        recorded: dict[str, Any] = json.loads(distribution(_OWN).read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, ValueError):
        recorded = {}
    if "dir_info" not in recorded:  # PEP 610: installed from a folder
        return shlex.quote(f"{_OWN}[{extra}]")
    url: str = recorded["url"]
    from urllib.request import url2pathname  # noqa: PLC0415 - brings HTTP and e-mail to every start of a server

    folder = url2pathname(urlsplit(url).path)
    editable = "-e " if recorded["dir_info"].get("editable") else ""
    return f"{editable}{shlex.quote(f'{folder}[{extra}]')}"


def _normalized(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")
