"""`docs/simulated-server.md` names every option and every robot there is, and no other."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator

from pages import ROOT, prose

from urlab_client.cli import _parser
from urlab_client.server import bundled_models

PAGE = prose(ROOT / "docs" / "simulated-server.md")


def table(heading: str) -> list[list[str]]:
    """Return the cells of the table below a heading."""
    section = re.split(r"^#+ ", PAGE.split(f"# {heading}\n")[1], flags=re.MULTILINE)[0]
    lines = [line for line in section.splitlines() if line.startswith("| ") and not line.startswith("| option | name")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[1:]]


def serve_options() -> Iterator[argparse.Action]:
    subparsers = next(a for a in _parser()._actions if isinstance(a, argparse._SubParsersAction))
    serve = subparsers.choices["serve"]
    yield from (action for action in serve._actions if action.option_strings and action.dest != "help")


def test_every_option_of_serve_has_a_row() -> None:
    documented = [name for row in table("Options") for name in re.findall(r"--[a-z-]+", row[0])]
    assert sorted(documented) == sorted(name for action in serve_options() for name in action.option_strings)


def test_the_default_ports_are_right() -> None:
    documented = {row[0].strip("`").split()[0]: row[1] for row in table("Options")}
    for action in serve_options():
        if action.dest.endswith("_port") and "default" in (action.help or ""):
            assert documented[action.option_strings[0]] == re.findall(r"default (\d+)", action.help or "")[0]


def test_every_bundled_robot_has_a_row() -> None:
    assert sorted(row[0].strip("`") for row in table("Bundled robots")) == sorted(bundled_models())
