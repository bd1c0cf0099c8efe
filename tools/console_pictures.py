"""Draw the pictures of the console in docs/images: python tools/console_pictures.py [FOLDER]

Needs Chromium with its driver, and the `test` extra. Shows two robots that move, as a person would see them.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.ui import WebDriverWait

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--window-size=1440,1000",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",  # the 3-D view, without a graphics card
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
)  # fmt: skip
SHOTS = {
    "console_light": (1440, 1000, "light"),
    "console_dark": (1440, 1000, "dark"),
    "console_phone": (390, 1500, "light"),
}
ADDRESS = "sim://arm?model=quadruped&play&unpaused&controller=quadruped=pd,kp=40,kv=1.5&camera-size=480x320"


@contextlib.contextmanager
def console() -> Iterator[str]:
    """Run `urlab console` and yield its link."""
    command = [sys.executable, "-m", "urlab_client", "console", ADDRESS, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - ours
        try:
            assert process.stdout is not None  # noqa: S101 - for the type checker
            yield next(word for word in process.stdout.readline().split() if word.startswith("http://"))
        finally:
            process.terminate()


@contextlib.contextmanager
def browser() -> Iterator[webdriver.Chrome]:
    """Yield a headless Chromium that knows nothing and forgets everything."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = Options()
        options.binary_location = os.environ.get("CHROMIUM", "/usr/bin/chromium")
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        driver = webdriver.Chrome(options, Service(os.environ.get("CHROMEDRIVER", "/usr/bin/chromedriver")))
        try:
            yield driver
        finally:
            driver.quit()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=IMAGES)
    folder: Path = parser.parse_args().folder
    with console() as link, browser() as driver:
        driver.get(link)
        wait = WebDriverWait(driver, 120)

        def until(script: str) -> None:
            wait.until(lambda d: d.execute_script(f"return {script}"))

        until("document.querySelectorAll('[data-robot]').length == 2")
        driver.execute_script(MOVE)
        driver.execute_script("document.querySelectorAll('#contacts details, .robot details')[0].open = true")
        until("document.querySelector('.stage iframe')?.contentWindow.eval('currentModelCrc') > 0")
        until("window.moved > 5")
        for name, (width, height, scheme) in SHOTS.items():
            driver.execute_cdp_cmd(
                "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
            )
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
            driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            until(f"innerWidth == {json.dumps(width)}")
            driver.execute_script(f"document.querySelector('#view-box').open = {json.dumps(width >= 600)}")
            before = driver.execute_script("return window.moved")
            until(f"window.moved > {before} + 2")
            until("[...document.querySelectorAll('.camera')].some(one => /fps/.test(one.innerText))")
            driver.save_screenshot(str(folder / f"{name}.png"))


# Drives as a person would: by the sliders.
MOVE = """
window.moved = 0;
const began = performance.now();
setInterval(() => {
  window.moved = (performance.now() - began) / 1000;
  for (const [name, size, rate] of [["shoulder_pan", 0.5, 0.9], ["elbow", 0.5, 1.3], ["wrist_pitch", 0.4, 1.7]]) {
    const slider = document.querySelector(`[data-robot=arm] [data-actuator=${name}]`);
    slider.value = size * Math.sin(rate * window.moved);
    slider.dispatchEvent(new Event("input", { bubbles: true }));
  }
}, 50);
"""


if __name__ == "__main__":
    main()
