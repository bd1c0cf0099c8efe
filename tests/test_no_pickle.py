"""Nothing that is received or read from a file can run code: no pickle, marshal, eval or the like in the package."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MODULES = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "copyreg"}
CALLS = {"eval", "exec", "compile", "__import__"}
# `compile` is also what turns a MuJoCo spec into a model; that is a method, these are plain names.


WORDS = re.compile(rf"\b({'|'.join(sorted(MODULES))}|allow_pickle)\b|(?<![.\w])({'|'.join(sorted(CALLS))})\s*\(")


def problems(source: str) -> list[str]:
    found: list[str] = []
    if not WORDS.search(source):
        return found  # parsing takes long
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        found += [name for name in names if name.partition(".")[0] in MODULES]
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and node.func.id in CALLS:
                found.append(node.func.id)
            found += [word.arg for word in node.keywords if word.arg == "allow_pickle" and _true(word.value)]
    return found


def _true(value: ast.expr) -> bool:
    return not (isinstance(value, ast.Constant) and value.value is False)


def test_the_package_unpickles_and_evaluates_nothing() -> None:
    files = sorted((ROOT / "src").rglob("*.py"))
    assert len(files) > 50
    assert {str(file): found for file in files if (found := problems(file.read_text("utf-8")))} == {}


def test_the_search_finds_what_it_looks_for() -> None:
    for source in ("import pickle", "from dill import loads", "eval(x)", "numpy.load(f, allow_pickle=True)"):
        assert problems(source), source
    assert not problems("spec.compile()\nnumpy.load(f, allow_pickle=False)")


def test_the_lint_rules_against_it_are_on() -> None:
    lint = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["ruff"]["lint"]
    assert "S" in lint["select"]  # S301 and S403 are pickle, S307 is eval
    ignored = [
        *lint["ignore"],
        *(rule for path, rules in lint["per-file-ignores"].items() if "src" in path for rule in rules),
    ]
    assert not [rule for rule in ignored if rule == "S" or rule.startswith(("S3", "S4"))]
