"""The generated reference is current and says what is true."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from pages import ROOT

from urlab_client.protocol.errors import RPC_ERRORS
from urlab_client.protocol.registry import OPS

REFERENCE = ROOT / "docs" / "reference" / "ops.md"


def load_tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("gen_docs", ROOT / "tools" / "gen_docs.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


gen_docs = load_tool()


def rows(heading: str) -> list[list[str]]:
    """Return the cells of the table rows below a heading and its sub-headings."""
    text = REFERENCE.read_text(encoding="utf-8")
    section = re.split(r"^## ", text.split(f"\n## {heading}\n")[1], flags=re.MULTILINE)[0]
    lines = [line for line in section.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_it_is_current() -> None:
    assert gen_docs.main(["--check"]) == 0, "run python tools/gen_docs.py"


def test_check_finds_a_stale_file_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "reference" / "ops.md"
    assert gen_docs.main(["--check"], output) == 1
    assert not output.exists()
    assert "stale: run python tools/gen_docs.py" in capsys.readouterr().err
    assert gen_docs.main([], output) == 0
    assert gen_docs.main(["--check"], output) == 0
    output.write_text(output.read_text() + "An edit by hand.\n")
    assert gen_docs.main(["--check"], output) == 1
    assert output.read_text().endswith("An edit by hand.\n")


def test_every_op_has_a_row_of_full_width() -> None:
    table = rows("Ops")
    assert sorted(row[0] for row in table) == sorted(f"`{name}`" for name in OPS)
    assert {len(row) for row in table} == {9}
    assert all(row[2] for row in table), "an op without a sentence"


def test_every_error_code_has_a_row() -> None:
    table = rows("Errors that a server answers")
    assert [row[0] for row in table] == [f"`{code}`" for code in RPC_ERRORS]
    assert {len(row) for row in table} == {5}


def test_the_kinds_of_errors_are_complete() -> None:
    from urlab_client.protocol import errors

    classes = {cls for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, errors.URLabError)}
    expected = {f"`{cls.__name__}`" for cls in classes - set(RPC_ERRORS.values()) - {errors.URLabError}}
    assert {row[0] for row in rows("All kinds of errors")} == expected


def test_an_op_without_a_method_is_refused() -> None:
    class Elsewhere:
        name, ns, method = "levitate", "runtime", "levitate"

    op: Any = Elsewhere()
    with pytest.raises(TypeError, match="levitate: RuntimeNamespace has no async method levitate"):
        gen_docs.method(op)
