"""The symptoms that `docs/howto/troubleshooting.md` lists are those that the code shows."""

from __future__ import annotations

import builtins
import re

import pytest
from pages import ROOT, prose

import urlab_client
from urlab_client import URLabCameraView, URLabClient

PAGE = prose(ROOT / "docs" / "howto" / "troubleshooting.md")
ROWS = [[cell.strip() for cell in line.split("|")[1:-1]] for line in PAGE.splitlines() if line.startswith("| ")][1:]
ERRORS = sorted({name for row in ROWS for name in re.findall(r"`([A-Z]\w+)`", row[0])})


def test_the_rows_have_symptom_cause_and_remedy() -> None:
    assert len(ROWS) > 15
    assert all(len(row) == 3 and all(row) for row in ROWS)


@pytest.mark.parametrize("name", ERRORS)
def test_errors_exist(name: str) -> None:
    error = getattr(urlab_client, name, None) or getattr(builtins, name)
    assert issubclass(error, Exception)


def test_methods_and_attributes_exist() -> None:
    text = " ".join(" ".join(row) for row in ROWS)
    for path in re.findall(r"`client\.([\w.]+)\(\)`", text):
        owner: object = URLabClient
        for part in path.split("."):
            found = getattr(owner, part, None)
            assert found is not None, f"client.{path}"
            owner = found.fget.__annotations__["return"] if isinstance(found, property) else found
            owner = getattr(urlab_client.sync.client, owner, owner) if isinstance(owner, str) else owner
    assert hasattr(URLabCameraView, "latest_frame")


def test_quoted_words_are_what_is_said() -> None:
    with URLabClient("sim://arm", step_mode="direct") as client:
        client.discover()
        with pytest.raises(KeyError, match="Did you mean 'elbow'"):
            client.articulations["arm"].set_ctrl({"elbo": 0.5})
        assert client.articulations["arm"].cameras["wrist"].latest_frame is None  # no picture asked for
    source = (ROOT / "src" / "urlab_client" / "__init__.py").read_text(encoding="utf-8")
    assert "cannot load urlab_client" in source
