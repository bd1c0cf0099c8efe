"""Every row of the API reference has a test, and docs/coverage.md says which."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_row_has_a_test_and_the_page_is_fresh() -> None:
    command = [sys.executable, str(ROOT / "tools" / "gen_coverage.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
