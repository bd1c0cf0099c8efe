"""The tool that plants bugs: its table fits the tree, and it tells what survives from what is caught."""

from __future__ import annotations

from pathlib import Path

import pytest

import plant_bugs
from named_tests import named_tests, unnamed

ADD = "def add(a, b):\n    return a + b\n"
TESTS = """
from adding import add

class TestAdding:
    def test_two_and_three(self):
        assert add(2, 3) == 5

def test_nothing():
    assert add(0, 0) == 0
"""


def entry(name: str, test: str, old: str = "a + b") -> str:
    return f'[[bug]]\nname = "{name}"\nold = "{old}"\nnew = "a - b"\ntests = ["{test}"]\n'


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package of one function, for whose tests pytest loads no more than it is given options of."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTEST_PLUGINS", "xdist.plugin,pytest_timeout")
    for path, text in {"src/adding.py": ADD, "tests/test_adding.py": TESTS, "pyproject.toml": ""}.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text)
    return tmp_path


def test_the_table_fits_the_tree() -> None:
    assert plant_bugs.problems(plant_bugs.read(), plant_bugs.ROOT) == []


def test_survivors_are_told_from_those_caught(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tree / "bugs.toml"
    table.write_text(entry("a wrong sign", "test_two_and_three") + entry("the same, unseen", "test_nothing"))
    assert plant_bugs.main([], table=table, root=tree) == 1
    out = capsys.readouterr().out.splitlines()
    assert out == ["caught     a wrong sign", "SURVIVES   the same, unseen", "1 of 2 caught, 1 survive"]
    assert (tree / "src/adding.py").read_text() == ADD


def test_what_is_not_fit_to_tell_is_refused(tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tree / "bugs.toml"
    table.write_text(entry("gone", "test_nothing", old="a * b") + entry("untested", "test_gone"))
    assert plant_bugs.main(["--check"], table=table, root=tree) == 1
    assert capsys.readouterr().out.splitlines() == [
        "gone: its text occurs 0 times in src, not once",
        "untested: 0 tests are called test_gone, not one",
    ]
    (tree / "tests/test_adding.py").write_text(TESTS.replace("== 0", "== 1"))
    table.write_text(entry("a wrong sign", "test_nothing"))
    assert plant_bugs.main([], table=table, root=tree) == 1
    assert capsys.readouterr().out.startswith("the tests fail without any bug:")


def test_tests_are_found_by_name(tree: Path) -> None:
    ids = named_tests(tree / "tests")
    assert ids["test_adding"] == ["tests/test_adding.py"]
    assert ids["test_two_and_three"] == ["tests/test_adding.py::TestAdding::test_two_and_three"]
    (tree / "tests/test_more.py").write_text("def test_nothing():\n    pass\n")
    ids = named_tests(tree / "tests")
    assert unnamed(["test_nothing", "test_more::test_nothing"], ids) == ["2 tests are called test_nothing, not one"]
    assert unnamed([], ids) == ["no test is named"]
