"""Every picture on the pages is made by a script of the repository, and every one that is made is on a page."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

from pages import ROOT, pages, prose

BY_HAND = {"layers.svg", "request.svg"}
"""Drawings that are text: their source is what is shown."""


def made() -> dict[str, tuple[str, str]]:
    spec = importlib.util.spec_from_file_location("pictures", ROOT / "tools" / "pictures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.PICTURES


def test_every_picture_has_a_script() -> None:
    shown = {Path(name).name for page in pages() for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", prose(page))}
    assert {path.name for path in (ROOT / "docs" / "images").iterdir()} == shown
    scripts = [
        path.read_text(encoding="utf-8") for folder in ("tools", "examples") for path in (ROOT / folder).glob("*.py")
    ]
    for name in shown - BY_HAND - set(made()):
        assert any(Path(name).stem in script for script in scripts), f"{name}: enter its script in tools/pictures.py"
    assert set(made()) <= shown


def test_the_drawings_name_what_there_is() -> None:
    package = ROOT / "src" / "urlab_client"
    named = {
        name: set(re.findall(r"[\w/]+\.py\b|[\w/]+/(?!\w)", " ".join(re.findall(r">([^<]+)</", drawing))))
        for name in BY_HAND
        for drawing in [(ROOT / "docs" / "images" / name).read_text(encoding="utf-8")]
    }
    for name, files in named.items():
        missing = [file for file in files if not (ROOT / file).exists() and not any(package.glob(f"**/{file}"))]
        assert files
        assert not missing, f"{name} shows what is not there"
    layers = {f"{path.parent.name}/" for path in package.glob("*/__init__.py")}
    rooms = {f"{path.parent.name}/" for layer in ("aio", "server") for path in (package / layer).glob("*/__init__.py")}
    assert layers | rooms <= named["layers.svg"]


def test_the_scripts_make_what_they_are_said_to() -> None:
    for name, (script, left) in made().items():
        source = (ROOT / script).read_text(encoding="utf-8")
        assert f'"{left or Path(name).stem}' in source or f'"{name}"' in source, f"{script} does not speak of {name}"
