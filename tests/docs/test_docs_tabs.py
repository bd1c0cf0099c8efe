"""What the hooks of the site make: tabs of code in both flavours, and the navigation of the reference."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from pages import ROOT, pages, shown

TAB = re.compile(r"^<!-- tab: (.*?) -->$", re.MULTILINE)


@pytest.mark.parametrize("page", [page for page in pages() if TAB.search(page.read_text("utf-8"))], ids=shown)
def test_tabs_come_in_pairs_above_code(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    names = TAB.findall(text)
    assert names == ["Blocking", "Async"] * (len(names) // 2)
    assert len(re.findall(r"^<!-- tab: .*? -->\n```python$", text, re.MULTILINE)) == len(names)


def test_the_home_page_and_the_quickstart_have_them() -> None:
    with_tabs = {shown(page) for page in pages() if TAB.search(page.read_text("utf-8"))}
    assert with_tabs >= {"README.md", "docs/index.md", "docs/start.md", "docs/quickstart.md"}


@pytest.fixture(name="hooks")
def fixture_hooks(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the hooks of the site, without MkDocs, which the tests do without."""
    for name in ("mkdocs", "mkdocs.structure", "mkdocs.structure.files"):
        monkeypatch.setitem(sys.modules, name, type(sys)(name))
    for name in ("File", "Files"):
        monkeypatch.setattr(sys.modules["mkdocs.structure.files"], name, object, raising=False)
    spec = importlib.util.spec_from_file_location("site_hooks_alone", ROOT / "tools" / "site_hooks.py")
    assert spec is not None
    assert spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    return hooks


def test_the_navigation_has_the_pages_that_a_page_lists_below_it(hooks: Any) -> None:
    nav = [{"Reference": [{"Command line": "reference/cli.md"}]}, "index.md"]
    (reference, home) = hooks.with_listed(nav, ROOT / "docs")
    ((index, first, *others),) = (below["Command line"] for below in reference["Reference"])
    assert (index, home) == ({"Command line": "reference/cli.md"}, "index.md")
    assert first == {"urlab serve": "reference/cli-serve.md"}
    assert len(others) + 1 == len(list((ROOT / "docs" / "reference").glob("cli-*.md")))


def test_the_navigation_goes_as_deep_as_pages_list_others(hooks: Any) -> None:
    _, *below = hooks.with_listed("reference/integrations.md", ROOT / "docs")
    (gym,) = (page["urlab_client.integrations.gym"] for page in below if "urlab_client.integrations.gym" in page)
    assert {"Tasks": "reference/integrations-gym-tasks.md"} in gym


def test_links_to_headings_that_moved_lead_to_their_page(hooks: Any, tmp_path: Path) -> None:
    page = tmp_path / "arm.md"
    (tmp_path / "arm-hand.md").write_text("# The hand\n\n## Use\n\n## What `grip` does\n\n```sh\n# no heading\n```\n")
    made = hooks.with_moved("# The arm\n\n## Use\n\nIt has [a hand](arm-hand.md), [which](arm-hand.md) grips.\n", page)
    anchors = "".join(
        f'<a id="{anchor}" data-moved="arm-hand.html#{anchor}"></a>' for anchor in ("the-hand", "what-grip-does")
    )
    assert made == f"# The arm\n\n## Use\n\nIt has {anchors}[a hand](arm-hand.md), [which](arm-hand.md) grips.\n"


def test_the_site_makes_tabs_of_neighbours_only(hooks: Any) -> None:
    tab = "<!-- tab: {0} -->\n```python\n{1}\n```\n"
    first, second, third = tab.format("Blocking", "a"), tab.format("Async", "b"), tab.format("Blocking", "c")
    page = f"{first}\n```text\n1\n```\n\n{second}\nwords\n\n{third}"
    made = hooks.tabs(page)
    assert re.findall(r'^===!? ".*"$', made, re.MULTILINE) == ['===! "Blocking"', '=== "Async"', '===! "Blocking"']
    assert '===! "Blocking"\n\n    ```python\n    a\n    ```\n\n    ```text\n    1\n    ```\n' in made
