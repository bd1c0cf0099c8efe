"""Tests by the names of their functions and modules, wherever they stand: for tables that outlive moves of modules."""

from __future__ import annotations

import ast
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

__all__ = ["named_tests", "unnamed"]


def named_tests(tests: Path) -> Mapping[str, Sequence[str]]:
    """Return pytest's ids, relative to the folder above `tests`, by name.

    The names are those of modules and of test functions. Where two share one, `folder/module` and `module::function`
    tell them apart.
    """
    ids: dict[str, list[str]] = defaultdict(list)
    for path in sorted(tests.rglob("test_*.py")):
        module = path.relative_to(tests.parent).as_posix()
        for name in {path.stem, path.relative_to(tests).with_suffix("").as_posix()}:
            ids[name].append(module)
        for node in ast.parse(path.read_text("utf-8")).body:
            in_class = isinstance(node, ast.ClassDef)
            prefix = f"{module}::{node.name}" if in_class else module
            for inner in node.body if in_class else [node]:
                if isinstance(inner, (ast.FunctionDef, ast.AsyncFunctionDef)) and inner.name.startswith("test_"):
                    for name in (inner.name, f"{path.stem}::{inner.name}"):
                        ids[name].append(f"{prefix}::{inner.name}")
    return ids


def unnamed(names: Sequence[str], ids: Mapping[str, Sequence[str]]) -> list[str]:
    """Return what is wrong with names that stand for no test, or for several; where there are none, too."""
    found = [
        f"{len(ids.get(name, ()))} tests are called {name}, not one" for name in names if len(ids.get(name, ())) != 1
    ]
    return found if names else ["no test is named"]
