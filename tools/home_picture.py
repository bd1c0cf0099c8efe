"""Take the picture of the documentation's home page in docs/images: python tools/home_picture.py [FOLDER]

Needs Chromium with its driver, and the extras `docs` and `test`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from console_pictures import IMAGES, Photographer, browser

ROOT = Path(__file__).resolve().parents[1]
SIZE = 1280, 900


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=IMAGES)
    folder: Path = parser.parse_args().folder
    with tempfile.TemporaryDirectory() as site, browser() as driver:
        build = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", site]
        subprocess.run(build, cwd=ROOT, check=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"})  # noqa: S603 - ours
        page = Photographer(driver, folder)
        page.resize(*SIZE, "light")
        driver.get(Path(site, "index.html").as_uri())
        page.until("[...document.images].every((image) => image.complete)")
        page.shoot("home")


if __name__ == "__main__":
    main()
