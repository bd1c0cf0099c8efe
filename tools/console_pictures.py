"""Draw the pictures of the console in docs/images: python tools/console_pictures.py [FOLDER]

Needs Chromium with its driver, and the `test` extra. Shows two robots that move, as a person would see them; then their
replay, and what the page says when the server has gone.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
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
    "console_phone": (390, 844, "light"),
    "console_sheet": (390, 844, "dark"),
}
SERVER = (
    "serve", "arm", "quadruped", "--play", "--unpaused", "--controller", "quadruped=pd,kp=40,kv=1.5",
    "--camera-size", "480x320", "--json", *(f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")),
)  # fmt: skip
QUALITY = 82


@contextlib.contextmanager
def command(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `urlab` and yield it with its first line."""
    with subprocess.Popen(  # noqa: S603 - ours
        [sys.executable, "-m", "urlab_client", *arguments], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None  # noqa: S101 - for the type checker
            yield process, process.stdout.readline()
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


class Photographer:
    """Takes pictures of the page, of a size and in a colour scheme."""

    def __init__(self, driver: webdriver.Chrome, folder: Path) -> None:
        self.driver = driver
        self._folder = folder

    def until(self, script: str) -> None:
        WebDriverWait(self.driver, 240, 0.2).until(lambda _: self.driver.execute_script(f"return {script}"), script)

    def resize(self, width: int, height: int, scheme: str) -> None:
        self.driver.execute_cdp_cmd(
            "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        )
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        self.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": width < 600})
        self.until(f"innerWidth == {width}")

    def settle(self) -> None:
        """Let some time pass for the page, so that what was resized is drawn."""
        before = self.driver.execute_script("return performance.now()")
        self.until(f"performance.now() > {before} + 4000")

    def shoot(self, name: str) -> None:
        picture = Image.open(io.BytesIO(self.driver.get_screenshot_as_png())).convert("RGB")
        picture.save(self._folder / f"{name}.webp", quality=QUALITY, method=6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=IMAGES)
    folder: Path = parser.parse_args().folder
    with tempfile.TemporaryDirectory() as recordings, command(*SERVER) as (server, line):
        ready = json.loads(line)
        ports = (f"--step-port={ready['step_port']}", f"--state-port={ready['state_port']}", "--port=0")
        with (
            command("console", ready["address"], *ports, f"--recordings={recordings}") as (_, said),
            browser() as driver,
        ):
            driver.set_script_timeout(240)  # without a graphics card a frame may take long
            page = Photographer(driver, folder)
            page.resize(1440, 1000, "light")  # before there is a 3-D view, which takes its time to follow
            driver.get(next(word for word in said.split() if word.startswith("http://")))
            take_all(page, server)


def take_all(page: Photographer, server: subprocess.Popen[str]) -> None:
    driver = page.driver
    page.until("document.querySelectorAll('[data-robot]').length == 2")
    page.until("document.querySelector('#view .cover').hidden")
    driver.execute_script(MOVE)
    for name, (width, height, scheme) in SHOTS.items():
        page.resize(width, height, scheme)
        if name.endswith("sheet"):
            driver.execute_script("document.querySelector('#sheet-toggle').click()")
        page.settle()
        page.until("!document.querySelector('#age').classList.contains('old')")  # also on a busy machine
        page.shoot(name)
    driver.execute_script("document.querySelector('#sheet-toggle').click()")
    page.resize(1440, 1000, "light")
    driver.execute_script("document.querySelector('#record').click()")
    page.until("parseFloat(document.querySelector('#record-progress').textContent) > 8")
    driver.execute_script("document.querySelector('#record').click()")
    page.until("document.querySelector('[data-recording] .replay') !== null")
    driver.execute_script("clearInterval(window.moving); document.querySelector('[data-recording] .replay').click()")
    page.until("+document.querySelector('#timeline').value > 0")
    driver.execute_script(
        "const line = document.querySelector('#timeline'); line.value = 0.6 * line.max;"
        "line.dispatchEvent(new Event('input'))"
    )
    page.settle()
    page.shoot("console_replay")
    driver.execute_script("document.querySelector('#replay-end').click()")
    page.until("document.querySelector('#replay').hidden")
    server.kill()
    page.until("document.querySelector('#banner').innerText.includes('for 4 s')")
    page.shoot("console_error")


# Drives as a person would: by the sliders.
MOVE = """
window.moved = 0;
const began = performance.now();
window.moving = setInterval(() => {
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
