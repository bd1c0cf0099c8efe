"""Whether another installed package overwrites this one.

Two distributions that both bring a top-level `urlab_client` write over each other's files, and what is left is neither.
Looking through all installed distributions takes a while, so it is done by `urlab doctor`, and when an import has
failed.
"""

from importlib.metadata import packages_distributions

__all__ = ["conflict"]

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


def _normalized(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")
