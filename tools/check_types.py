"""Check that the types of the public interface are complete, as users' type checkers see them.

Run: python tools/check_types.py

Prints what is unknown or left to inference, which type checkers do differently. Exit code 1 if the share of symbols
with known types is below what is asked for, or if a program that uses the model, without stubs for MuJoCo, meets a type
that pyright or mypy does not know. What other packages leave unknown counts for nothing.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

LEAST = 0.99
PACKAGE = "urlab_client"
LIMIT_S = 300.0

PROGRAM = """\
from urlab_client import URLabClient
from urlab_client.aio import URLabClient as AsyncClient

for client in (URLabClient("sim://arm"), AsyncClient("sim://arm")):
    assert client.model is not None and client.data is not None
    reveal_type(client.model.nq)
    reveal_type(client.model.opt.timestep)
    reveal_type(client.model.jnt_range)
    reveal_type(client.data.qpos)
    reveal_type(client.data.time)
"""
REVEALED = PROGRAM.count("reveal_type")
_KNOWN = re.compile(r"(Type of .* is|Revealed type is) \"(int|float|(numpy\.)?ndarray\[.*float64\]\]+)\"")


def report() -> dict[str, Any]:
    """Return what pyright says of the package that this interpreter imports."""
    return _pyright("--verifytypes", PACKAGE, "--ignoreexternal", folder=Path.cwd())["typeCompleteness"]


def unknown() -> list[str]:
    """Return the types in a user's program, in a folder of its own, that a type checker does not know."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "pyrightconfig.json").write_text('{"strict": ["."]}', encoding="utf-8")
        (Path(folder) / "program.py").write_text(PROGRAM, encoding="utf-8")
        told = {
            "pyright": [one["message"] for one in _pyright("program.py", folder=Path(folder))["generalDiagnostics"]],
            "mypy": _run("mypy", "--strict", "program.py", folder=Path(folder)).splitlines()[:-1],
        }
    problems = [f"{checker}: {line}" for checker, lines in told.items() for line in lines if not _KNOWN.search(line)]
    few = [f"{checker} revealed too little" for checker, lines in told.items() if len(lines) < REVEALED]
    return [*problems, *few]


def _pyright(*arguments: str, folder: Path) -> dict[str, Any]:
    return json.loads(_run("pyright", *arguments, "--outputjson", folder=folder))


def _run(program: str, *arguments: str, folder: Path) -> str:
    # pyright looks for the interpreter on the path, and for nothing else, when it verifies types.
    here = Path(sys.executable).parent
    done = subprocess.run(  # noqa: S603 - the type checkers of this environment
        [here / program, *arguments],
        cwd=folder,
        env={**os.environ, "PATH": f"{here}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    return done.stdout


def main() -> int:
    found = report()
    for symbol in found["symbols"]:
        if symbol["isExported"] and not symbol["isTypeKnown"]:
            reasons = [line for one in symbol["diagnostics"] for line in one["message"].splitlines()]
            print(f"{symbol['name']}: {' '.join(reasons) or 'made of such types'}")
    score: float = found["completenessScore"]
    print(f"{100 * score:.2f} % of the public symbols have known types; {100 * LEAST:.0f} % are asked for")
    problems = unknown()
    for problem in problems:
        print(f"a user's program: {problem}")
    return int(score < LEAST or bool(problems))


if __name__ == "__main__":
    sys.exit(main())
