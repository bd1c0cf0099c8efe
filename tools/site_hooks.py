"""What the site adds to the pages in `docs/`, as hooks of MkDocs.

The pages at the root of the repository belong to the site, too, and links between the two work in both places. Files
that are not pages, such as sources, are named but not linked. In the navigation, pages `NAME-….md` stand below the page
`NAME.md` that lists them, in its order; a page that the navigation does not mention is put at its end. Links to
headings that moved from `NAME.md` to one of those pages still lead to them, by `docs/assets/moved.js`. Code blocks
under `<!-- tab: NAME -->`, one after the other, become tabs, and those of one name open together.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkdocs.structure.files import File, Files

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent
ROOT_PAGES = {
    name: f"project/{name.lower()}" for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md")
}

# Weight of pages in the search, by how their path begins: an answer comes before a class, a class before a list.
_BOOSTS = {"howto/": 4.0, "quickstart": 3.0, "concepts": 2.0, "tutorials/": 2.0, "reference/blocking": 0.7,
           "reference/": 0.5, "coverage": 0.1, "promises": 0.1, "evidence": 0.1, "project/": 0.3}  # fmt: skip

_LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^]]*)\]\((?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)")
_TAB = re.compile(
    r"^<!-- tab: (?P<name>[^\n]+?) -->\n(?P<body>```.*?^```$(?:\n\n```text\n.*?^```$)?)", re.MULTILINE | re.DOTALL
)
_HEADING = re.compile(r"^#+ +(.*?) *$", re.MULTILINE)
_CODE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put pages in the navigation below the one that lists them; those that it does not mention, at its end."""
    docs = Path(config.docs_dir)
    config.nav = with_listed(config.nav, docs)
    named = set(_targets(config.nav))
    others = sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))
    if missing := [name for name in others if name not in named]:
        config.nav = [*(config.nav or []), {"More": missing}]
    return config


def with_listed(nav: Any, docs: Path) -> Any:
    """Return a navigation in which the pages `NAME-….md` that `NAME.md` links to stand below it.

    Args:
        nav: Navigation, or a part of it, as MkDocs reads it.
        docs: Folder of the pages.
    """
    if isinstance(nav, list):
        return [with_listed(item, docs) for item in nav]
    if isinstance(nav, dict):
        return {title: with_listed(item, docs) for title, item in nav.items()}
    path = docs / nav if isinstance(nav, str) else None
    if path is None or not path.exists():
        return nav
    listed = dict.fromkeys(re.findall(rf"\]\(({re.escape(path.stem)}-[\w-]+)\.md", path.read_text(encoding="utf-8")))
    names = [f"{name}.md" for name in listed if not any(name.startswith(f"{other}-") for other in listed)]
    below = [
        {_heading(path.parent / name): with_listed(posixpath.join(posixpath.dirname(nav), name), docs)}
        for name in names
    ]
    return [{_heading(path): nav}, *below] if below else nav


def _heading(page: Path) -> str:
    """Return a page's title, which MkDocs does not find below the comment of a generated page."""
    found = re.search(r"^# (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return page.stem if found is None else found[1].replace("`", "")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages at the root of the repository."""
    for name, uri in ROOT_PAGES.items():
        files.append(File.generated(config, uri, content=(ROOT / name).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to where the site has the page; take those away that lead out of it."""
    uri = page.file.src_uri
    if boost := next((boost for start, boost in _BOOSTS.items() if uri.startswith(start)), None):
        page.meta["search"] = {"boost": boost}
    source = next((name for name, own in ROOT_PAGES.items() if own == uri), f"docs/{uri}")
    kept: list[str] = []
    end = 0
    for block in _CODE.finditer(markdown):
        kept += [_LINK.sub(lambda link: _link(link, source, uri, files), markdown[end : block.start()]), block[0]]
        end = block.end()
    kept.append(_LINK.sub(lambda link: _link(link, source, uri, files), markdown[end:]))
    return with_moved(tabs("".join(kept)), Path(config.docs_dir) / uri)


def with_moved(markdown: str, page: Path) -> str:
    """Return a page `NAME.md` with the anchors of the pages `NAME-….md` where it first links to each.

    Args:
        markdown: The page, as it is to be shown.
        page: Where it comes from; the pages below it are in the same folder.
    """
    known = _anchors(markdown)
    for name in dict.fromkeys(re.findall(rf"\]\(({re.escape(page.stem)}-[\w-]+)\.md", markdown)):
        moved = [anchor for anchor in _anchors((page.parent / f"{name}.md").read_text("utf-8")) if anchor not in known]
        known.update(dict.fromkeys(moved))
        targets = "".join(f'<a id="{anchor}" data-moved="{name}.html#{anchor}"></a>' for anchor in moved)
        markdown = re.sub(
            rf"\[[^]]*\]\({re.escape(name)}\.md", lambda link, to=targets: to + link[0], markdown, count=1
        )
    return markdown


def _anchors(markdown: str) -> dict[str, None]:
    """Return the anchors of a page's headings in order, as the site makes them."""
    headings = _HEADING.findall(_CODE.sub("", markdown))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-"): None for heading in headings}


def tabs(markdown: str) -> str:
    """Return a page in which blocks under `<!-- tab: NAME -->` are tabs; text between two begins a new set."""

    def tab(found: re.Match[str]) -> str:
        start = markdown[: found.start()].rstrip()
        first = "" if any(start.endswith(other) for other in bodies) else "!"
        bodies.append(found["body"])
        lines = "\n".join(f"    {line}" if line else "" for line in found["body"].splitlines())
        return f'==={first} "{found["name"]}"\n\n{lines}'

    bodies: list[str] = []
    return _TAB.sub(tab, markdown)


def _link(link: re.Match[str], source: str, uri: str, files: Files) -> str:
    target = link["target"]
    if re.match(r"[a-z]+:", target):
        return link[0]
    file = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
    to = ROOT_PAGES.get(file, file.removeprefix("docs/"))
    if not file.startswith("docs/") and file not in ROOT_PAGES:
        return link["text"]
    if files.get_file_from_path(to) is None:
        return link[0]  # MkDocs says what is wrong with it
    relative = posixpath.relpath(to, posixpath.dirname(uri) or ".")
    return f"{link['picture']}[{link['text']}]({relative}{link['anchor'] or ''})"


def _targets(nav: Any) -> list[str]:
    if isinstance(nav, str):
        return [nav]
    items = nav.values() if isinstance(nav, dict) else nav or ()
    return [target for item in items for target in _targets(item)]
