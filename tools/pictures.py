"""Make the pictures in `docs/images` again: python tools/pictures.py [NAME...], all without a name.

`PICTURES` says which script makes which. Examples run in a temporary folder, and the file they leave is copied;
the other scripts know where to write. Drawings not named here are text, edited by hand.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
PICTURES = {
    "console_dark.webp": ("tools/console_pictures.py", ""),
    "console_error.webp": ("tools/console_pictures.py", ""),
    "console_light.webp": ("tools/console_pictures.py", ""),
    "console_phone.webp": ("tools/console_pictures.py", ""),
    "console_replay.webp": ("tools/console_pictures.py", ""),
    "console_sheet.webp": ("tools/console_pictures.py", ""),
    "frames.svg": ("tools/gen_frames.py", ""),
    "gym_arm.png": ("examples/gym_env.py", "arm.png"),
    "home.webp": ("tools/home_picture.py", ""),
    "policy.png": ("examples/run_policy.py", "policy.png"),
    "ray_timeline.png": ("examples/ray_rollouts.py", "timeline.png"),
    "recorded_run.png": ("examples/record_run.py", "run.png"),
    "trot.webp": ("tools/home_animation.py", ""),
    "viewport.png": ("examples/viewport_picture.py", "viewport.png"),
    "walk.png": ("tools/walk_figures.py", ""),
}
"""Picture: the script that makes it, and the name under which an example leaves it."""


def make(script: str, wanted: dict[str, str]) -> None:
    """Run a script and copy what it left: pictures by the names that it gives them."""
    with tempfile.TemporaryDirectory(prefix="pictures") as temporary:
        environment = {**os.environ, "MPLBACKEND": "agg"}
        subprocess.run([sys.executable, ROOT / script], cwd=temporary, env=environment, check=True)  # noqa: S603 - ours
        for left, name in wanted.items():
            shutil.copy(Path(temporary) / left, IMAGES / name)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", choices=[[], *PICTURES], metavar="NAME", help="files in docs/images")
    names = parser.parse_args(argv).names or PICTURES
    scripts: dict[str, dict[str, str]] = {}
    for name in names:
        script, left = PICTURES[name]
        scripts.setdefault(script, {}).update({left: name} if left else {})
    for script, wanted in scripts.items():
        make(script, wanted)
    return 0


if __name__ == "__main__":
    sys.exit(main())
