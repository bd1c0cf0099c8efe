"""The generated reference is current and says what is true."""

from __future__ import annotations

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pages import ROOT

import gen_cli
import gen_docs
from urlab_client.aio.namespaces.scene import SceneNamespace
from urlab_client.cli import _parser
from urlab_client.errors import RPC_ERRORS
from urlab_client.protocol.messages.scene import CreateLevel
from urlab_client.protocol.registry import OPS

REFERENCE = ROOT / "docs" / "reference"


def rows(page: str, heading: str = "") -> list[list[str]]:
    """Return the cells of the table rows of a page, or of those below a heading and its sub-headings."""
    text = (REFERENCE / page).read_text(encoding="utf-8")
    section = re.split(r"^## ", (text.split(f"\n## {heading}\n")[1] if heading else text), flags=re.MULTILINE)[0]
    lines = [line for line in section.splitlines() if line.startswith(("| `", "| [`"))]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]


def test_it_is_current() -> None:
    assert gen_docs.main(["--check"]) == 0, "run python tools/gen_docs.py"


def test_check_finds_a_stale_file_and_writes_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "reference"
    assert gen_docs.main(["--check"], folder) == 1
    assert not folder.exists()
    assert "run: python tools/gen_docs.py" in capsys.readouterr().err
    assert gen_docs.main([], folder) == 0
    assert gen_docs.main(["--check"], folder) == 0
    pages = sorted(folder.iterdir())
    for page in pages:
        page.write_bytes(page.read_bytes() + b"An edit by hand.\n")
    capsys.readouterr()
    assert gen_docs.main(["--check"], folder) == 1
    told = capsys.readouterr().err
    assert [page.name for page in pages if f"{page.name}: stale" not in told] == []
    assert all(page.read_bytes().endswith(b"An edit by hand.\n") for page in pages)


def test_every_op_has_a_row_of_full_width() -> None:
    table = [row for namespace in gen_docs.namespaces() for row in rows(gen_docs.namespace_page("ops", namespace))]
    assert sorted(row[0] for row in table) == sorted(
        f"[`{name}`]({gen_docs.field_page(op)}#{name})" for name, op in OPS.items()
    )
    assert {len(row) for row in table} == {6}
    assert all(row[2] for row in table), "an op without a sentence"


def test_every_error_code_has_a_row() -> None:
    table = rows("ops-errors.md")
    assert [row[0] for row in table] == [f"`{code}`" for code in RPC_ERRORS]
    assert {len(row) for row in table} == {5}


def test_the_kinds_of_errors_are_complete() -> None:
    from urlab_client import errors

    classes = {cls for cls in vars(errors).values() if isinstance(cls, type) and issubclass(cls, errors.URLabError)}
    expected = {f"`{cls.__name__}`" for cls in classes - set(RPC_ERRORS.values()) - {errors.URLabError}}
    assert {row[0] for row in rows("ops-exceptions.md")} == expected


def test_an_op_without_a_method_is_refused() -> None:
    class Elsewhere:
        name, ns, method = "levitate", "runtime", "levitate"

    op: Any = Elsewhere()
    with pytest.raises(TypeError, match="levitate: RuntimeNamespace has no async method levitate"):
        gen_docs.method(op)


@pytest.mark.parametrize("op", OPS.values(), ids=lambda op: op.name)
def test_every_field_of_an_op_has_a_row_with_type_default_and_meaning(op: Any) -> None:
    text = (REFERENCE / gen_docs.field_page(op)).read_text(encoding="utf-8")
    section = re.split(r"^##+ ", text.split(f"\n## `{op.name}`\n")[1], flags=re.MULTILINE)[0]
    request, reply = section.split(f"\nReply `{op.reply_name}`:\n")
    assert f"Category `{op.needs.value}`." in request
    assert all(f"`{code}`" in request for code in op.errors)
    for part, struct in ((request, op.request), (reply, op.reply)):
        table = [re.split(r"(?<!\\)\|", line)[1:-1] for line in part.splitlines() if line.startswith("| `")]
        expected = {f.encode_name for f in msgspec.structs.fields(struct)} - {"session_id"}
        assert {row[0].strip(" `") for row in table} == expected
        assert all(len(row) == 4 and all(cell.strip() for cell in row) for row in table)


PUBLIC = (
    "urlab_client",
    *(f"urlab_client.{name}" for name in ("aio", "enums", "events", "server", "sync", "types")),
    *gen_docs.around(),
)


@pytest.mark.parametrize("module", PUBLIC)
def test_every_public_name_is_in_the_reference(module: str) -> None:
    # mkdocstrings fills in what these lines name, and the strict build of the site fails where it finds nothing.
    pages = sorted((ROOT / "docs" / "reference").glob("*.md"))
    lines = [line for page in pages for line in re.findall(r"^::: (\S+)$", page.read_text("utf-8"), re.MULTILINE)]
    assert len(set(lines)) == len(lines), "something is in the reference twice"
    in_tables = {cls.__name__ for cls in RPC_ERRORS.values()} | {"__version__"}
    names = {name: where for name, where in gen_docs.exports(module).items() if not name.startswith("pytest_")}
    missing = [name for name, where in names.items() if where not in lines and name not in in_tables]
    assert not missing, f"a page in docs/reference lacks {[f'::: {names[name]}' for name in missing]}"


def test_where_public_names_are_defined_is_found() -> None:
    import urlab_client.server

    assert set(gen_docs.exports("urlab_client.server")) == set(urlab_client.server.__all__)
    for name, where in gen_docs.exports("urlab_client.server").items():
        module, _, attribute = where.rpartition(".")
        assert getattr(importlib.import_module(module), attribute) is getattr(urlab_client.server, name)


def test_every_option_of_every_command_is_in_the_reference() -> None:
    for name, command in _parser().commands.items():
        section = (REFERENCE / f"cli-{name}.md").read_text(encoding="utf-8")
        options = re.findall(r"(?<![\w-])--[a-z-]+", command.format_help().split("\nexamples:")[0])
        assert [option for option in options if option not in (*section.split("`"), "--help")] == [], name
        assert all(f"`{line}`" in section for line, _ in command.examples)


def test_the_reference_of_the_commands_is_current(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert gen_cli.main(["--check"]) == 0, "run python tools/gen_cli.py"
    monkeypatch.setattr(gen_cli, "OUTPUT", tmp_path)
    assert gen_cli.main(["--check"]) == 1
    assert gen_cli.main([]) == 0
    assert gen_cli.main(["--check"]) == 0
    (tmp_path / "cli-levitate.md").write_text(f"{gen_cli.GENERATED}\n", encoding="utf-8")
    assert gen_cli.main(["--check"]) == 1, "the page of a command that is gone"
    assert gen_cli.main([]) == 0
    assert not (tmp_path / "cli-levitate.md").exists()


def test_help_shows_a_methods_text_as_its_op_declares_it() -> None:
    text = inspect.getdoc(SceneNamespace.create_level) or ""
    assert text.startswith(f"{inspect.getdoc(CreateLevel)}\n\nArgs:\n")
