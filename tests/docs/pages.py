"""Read the Markdown pages of the repository: their code blocks, links and headings.

A block may carry a directive, an HTML comment on the line above it, which readers do not see:

    <!-- test -->                        python block: a test file, run by pytest
    <!-- file: FILE -->                  python block: a file that later commands of the page read
    <!-- needs: EXTRA -->                python block: run where the extra is installed, apart from the others
    <!-- as is: REASON -->               text block that is not an output: why it does not run

and on `docs/adding-an-op.md`, for `test_docs_adding_an_op.py`:

    <!-- append: FILE -->                write it at the end of FILE
    <!-- insert: FILE before: LINE -->   write it above the only line of FILE that reads LINE
    <!-- insert: FILE after: LINE -->    write it below that line
    <!-- shows: FILE -->                 stands in FILE afterwards
    <!-- use -->                         runs afterwards
    <!-- tests -->                       tests that pass afterwards
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

_FENCE = re.compile(r"^```(?P<language>\S*)\s*$")
_DIRECTIVE = re.compile(r"^<!-- (?P<directive>(?:test|use|file:|needs:|as is:|append:|insert:|shows:).*?) -->$")


@dataclass(frozen=True)
class Block:
    """A fenced code block.

    Attributes:
        page: File it stands in.
        line: Number of its first line of code.
        language: What follows the opening fence.
        code: The lines between the fences.
        directive: Content of the directive above it, or empty.
        output: Content of the `text` block right below it: what it prints; None if there is no such block.
    """

    page: Path
    line: int
    language: str
    code: str
    directive: str = ""
    output: str | None = None

    def __str__(self) -> str:
        return f"{shown(self.page)}:{self.line}"


def pages() -> list[Path]:
    """Return every page of the documentation."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def shown(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page in order. A `text` block right below another one is that one's output."""
    found: list[Block] = []
    last_end = -1
    lines = page.read_text(encoding="utf-8").splitlines()
    number = 0
    while number < len(lines):
        fence = _FENCE.match(lines[number])
        if fence is None:
            assert "```" not in lines[number], f"{shown(page)}:{number + 1}: a fence that is none"
            number += 1
            continue
        end = next(i for i in range(number + 1, len(lines)) if lines[i].strip() == "```")
        code = "".join(f"{line}\n" for line in lines[number + 1 : end])
        above = _DIRECTIVE.match(lines[number - 1]) if number else None
        language = fence["language"]
        if language == "text" and found and not any(lines[last_end + 1 : number]):
            previous = found.pop()
            found.append(Block(page, previous.line, previous.language, previous.code, previous.directive, code))
        else:
            found.append(Block(page, number + 2, language, code, above["directive"] if above else ""))
        last_end = end
        number = end + 1
    return found


def prose(page: Path) -> str:
    """Return a page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ +(.*?) *$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
