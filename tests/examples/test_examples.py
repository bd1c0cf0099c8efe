"""Every example runs in a folder of its own and says something."""

from __future__ import annotations

import os
import secrets
import subprocess
import sys
from pathlib import Path

import pytest

# Examples that need an extra which the test command does not install, or several seconds: the marker of their tests.
# Examples that serve until they are told to stop, and the tests of which are elsewhere.
SERVING = {"fastapi_backend"}

# What a test of its own runs, with fewer episodes.
SHORTENED = {"clone_behaviour"}

# What no extra of the project installs: tools/check_learning.py runs four, the fifth takes some minutes.
FOREIGN = {"learn_by_sight", "ppo", "push_by_sight", "rllib_reach", "train_walk"}

MARKED = {
    "ray_rollouts": pytest.mark.ray,
    "view_rerun": pytest.mark.view,
    "viewport_picture": pytest.mark.opengl,
    "vector_env": pytest.mark.long,
    **dict.fromkeys(("gym_env", "record_run", "run_policy"), (pytest.mark.long, pytest.mark.opengl)),
}

EXAMPLES = sorted(
    path
    for path in (Path(__file__).parents[2] / "examples").glob("*.py")
    if path.stem not in SERVING | FOREIGN | SHORTENED
)


@pytest.mark.parametrize(
    "example", [pytest.param(path, id=path.stem, marks=MARKED.get(path.stem, ())) for path in EXAMPLES]
)
def test_example_runs(example: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", example],
        cwd=tmp_path,
        # Ray would leave a token in the home folder.
        env={"RAY_AUTH_TOKEN": secrets.token_hex(32), **os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
