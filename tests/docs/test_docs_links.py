"""What the pages refer to exists: pages, headings, pictures, source files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pages import ROOT, anchors, blocks, pages, prose, shown

PACKAGE = ROOT / "src" / "urlab_client"


@pytest.mark.parametrize("page", pages(), ids=shown)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            assert target.startswith("https://"), target
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.is_relative_to(ROOT), f"{shown(page)}: {target} leads out of the repository"
        assert file.exists(), f"{shown(page)}: {target} does not exist"
        if anchor:
            assert anchor in anchors(file), f"{shown(page)}: {target}: no such heading"


@pytest.mark.parametrize("page", [*pages(), *sorted((ROOT / "docs").rglob("*.svg"))], ids=shown)
def test_source_files_named_in_text_exist(page: Path) -> None:
    text = prose(page) if page.suffix == ".md" else page.read_text(encoding="utf-8")
    quoted = re.findall(r"`([^`\s]+)`", text) if page.suffix == ".md" else re.split(r"[\s<>,]+", text)
    for name in quoted:
        if re.fullmatch(r"[\w./-]+/[\w.-]*", name) and re.match(
            r"(src|tests|tools|docs|typings|aio|sync|server|protocol|cli|\.ci)/", name
        ):
            assert (ROOT / name).exists() or (PACKAGE / name).exists(), f"{shown(page)}: {name} does not exist"


def test_every_thread_is_in_the_page_about_threads() -> None:
    sources = [
        path.read_text(encoding="utf-8")
        for part in ("aio", "sync", "server")
        for path in PACKAGE.rglob(f"{part}/**/*.py")
    ]
    threads = {name for source in sources for name in re.findall(r'[tT]hread\(\s*"(urlab-[a-z]+)"', source)}
    page = (ROOT / "docs" / "architecture-threads.md").read_text(encoding="utf-8")
    assert threads >= {"urlab-io", "urlab-rpc", "urlab-physics"}
    assert sorted(threads - set(re.findall(r"`(urlab-[a-z]+)`", page))) == []


def test_every_page_can_be_reached() -> None:
    reachable = {ROOT / "README.md"}
    queue = [ROOT / "README.md"]
    while queue:
        page = queue.pop()
        for target in re.findall(r"\]\(([^)\s#]+)[^)]*\)", prose(page)):
            file = (page.parent / target).resolve()
            if file.suffix == ".md" and file.exists() and file not in reachable:
                reachable.add(file)
                queue.append(file)
    assert reachable == set(pages())


def test_the_list_of_all_pages_has_them() -> None:
    """Those below `NAME.md`, `NAME-….md`, are in the navigation."""
    docs = ROOT / "docs"
    page = docs / "contents.md"
    listed = {(docs / target).resolve() for target in re.findall(r"\]\(([^)\s#]+\.md)", prose(page))}
    tops = {file.stem for file in docs.glob("*.md") if "-" not in file.stem}
    missing = [
        shown(file)
        for folder in ("", "howto", "tutorials")
        for file in sorted((docs / folder).glob("*.md"))
        if file not in {*listed, page} and ("-" not in file.stem or file.stem.partition("-")[0] not in tops)
    ]
    assert missing == []


def test_the_tree_in_a_page_has_no_tabs_or_trailing_blanks() -> None:
    for page in pages():
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
            assert line == line.rstrip(), f"{shown(page)}:{number}: trailing blanks"
            assert "\t" not in line, f"{shown(page)}:{number}: a tab"
        for block in blocks(page):
            widest = max(map(len, block.code.splitlines()), default=0)
            assert widest <= 120, f"{block}: a line of {widest} characters"
