"""Check that the types of the public interface are complete, as users' type checkers see them.

Run: python tools/check_types.py

Prints what is unknown or left to inference, which type checkers do differently. Exit code 1 if the share of symbols
with known types is below what is asked for. What other packages leave unknown, such as MuJoCo without `mujoco-stubs`,
counts for nothing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

LEAST = 0.99
PACKAGE = "urlab_client"
LIMIT_S = 300.0


def report() -> dict[str, Any]:
    """Return what pyright says of the package that this interpreter imports."""
    here = Path(sys.executable).parent
    done = subprocess.run(  # noqa: S603 - the type checker of this environment
        [here / "pyright", "--verifytypes", PACKAGE, "--ignoreexternal", "--outputjson"],
        env={**os.environ, "PATH": f"{here}{os.pathsep}{os.environ['PATH']}"},  # where it looks for the interpreter
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    return json.loads(done.stdout)["typeCompleteness"]


def main() -> int:
    found = report()
    for symbol in found["symbols"]:
        if symbol["isExported"] and not symbol["isTypeKnown"]:
            reasons = [line for one in symbol["diagnostics"] for line in one["message"].splitlines()]
            print(f"{symbol['name']}: {' '.join(reasons) or 'made of such types'}")
    score: float = found["completenessScore"]
    print(f"{100 * score:.2f} % of the public symbols have known types; {100 * LEAST:.0f} % are asked for")
    return int(score < LEAST)


if __name__ == "__main__":
    sys.exit(main())
