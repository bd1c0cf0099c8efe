"""The page in a real Chromium: `urlab console` before it, `urlab serve` behind that."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.ui import WebDriverWait

FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--window-size=1300,900",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
FLAT = ("--disable-gpu", "--disable-3d-apis")
SOLID = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL without a graphics card
PATIENCE_S = 40
RUNNING = "document.querySelector('#play').textContent.includes('Pause')"
SLIDER = "[data-robot=arm] [data-actuator=elbow]"


@contextlib.contextmanager
def command(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `urlab` and yield it with the line that it prints first."""
    with subprocess.Popen([sys.executable, "-m", "urlab_client", *arguments], stdout=subprocess.PIPE, text=True) as one:
        try:
            assert one.stdout is not None
            yield one, one.stdout.readline()
        finally:
            one.kill()


def serve(*ports: str) -> contextlib.AbstractContextManager[tuple[subprocess.Popen[str], str]]:
    return command("serve", "arm", "--play", "--unpaused", "--json", "--camera-size", "64x48", *ports)


class Page:
    """One browser, and what is seen in it."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def look(self, script: str) -> Any:
        return self.driver.execute_script(f"return {script}")

    def until(self, script: str) -> None:
        WebDriverWait(self.driver, PATIENCE_S, 0.05).until(lambda _: self.look(script), f"never: {script}")

    def click(self, selector: str) -> None:
        self.until(f"document.querySelector('{selector}')?.disabled === false")
        self.look(f"document.querySelector('{selector}').click()")

    def slide(self, value: float) -> None:
        self.driver.execute_script(
            "const slider = document.querySelector(arguments[0]); slider.value = arguments[1];"
            "slider.dispatchEvent(new Event('input', {bubbles: true}))",
            SLIDER, value,
        )  # fmt: skip

    def invitation(self) -> str:
        """Return a link for one more browser."""
        return str(
            self.driver.execute_async_script(
                "const done = arguments[0]; fetch('api/invitations', {method: 'POST'})"
                ".then(a => a.json()).then(a => done(new URL(a.path, location.href).href))"
            )
        )

    def elbow_is(self, value: float) -> str:
        shown = "document.querySelector('[data-robot=arm] [data-value=elbow]').textContent"
        return f"Math.abs(parseFloat({shown}.replace('\u2212', '-')) - {value}) < 0.03"


@contextlib.contextmanager
def opened(folder: Path, link: str, flags: tuple[str, ...] = FLAT) -> Iterator[Page]:
    options = Options()
    options.binary_location = "/usr/bin/chromium"
    for flag in (*FLAGS, *flags, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, Service("/usr/bin/chromedriver"))
    try:
        driver.get(link)
        yield Page(driver)
    finally:
        driver.quit()


@pytest.fixture(scope="module")
def console() -> Iterator[tuple[dict[str, Any], str, contextlib.ExitStack]]:
    """A server, the link to a console before it, and what holds the server."""
    with contextlib.ExitStack() as stack:
        _, line = stack.enter_context(serve(*(f"--{n}-port=0" for n in ("step", "state", "ctrl", "info", "camera"))))
        ready = json.loads(line)
        with command(
            "console", ready["address"], f"--step-port={ready['step_port']}", f"--state-port={ready['state_port']}",
            "--port=0",
        ) as (_, said):  # fmt: skip
            yield ready, next(word for word in said.split() if word.startswith("http://")), stack


@pytest.fixture(scope="module")
def page(
    console: tuple[dict[str, Any], str, contextlib.ExitStack], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Page]:
    with opened(tmp_path_factory.mktemp("one"), console[1]) as one:
        one.until(f"document.querySelector('{SLIDER}') !== null")
        yield one


def test_a_slider_moves_its_joint(page: Page) -> None:
    page.until(RUNNING)
    for target in (0.6, -0.3):
        page.slide(target)
        page.until(page.elbow_is(target))
    page.until("document.querySelector('#driver').dataset.who === 'me'")


def test_cameras_and_curves_are_drawn(page: Page) -> None:
    page.until("document.querySelectorAll('.camera').length === 2")
    page.until("[...document.querySelectorAll('.camera')].every(one => /fps/.test(one.innerText))")
    pixels = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    drawn = f"(canvas => {pixels}.some((value, i) => i % 4 === 1 && value > 90))"  # in colours, not in black
    page.driver.execute_script("document.querySelector('.curve').scrollIntoView()")
    page.until(f"{drawn}(document.querySelector('.curve canvas'))")


def test_the_stop_button_stops_and_space_goes_on(page: Page) -> None:
    page.until(RUNNING)
    page.click("#stop")
    page.until(f"!({RUNNING})")
    page.slide(0.9)
    page.until("document.querySelector('#log').innerText.includes('set_paused')")
    assert not page.look(page.elbow_is(0.9))
    page.driver.execute_script("document.dispatchEvent(new KeyboardEvent('keydown', {key: ' ', bubbles: true}))")
    page.driver.execute_script("document.body.dispatchEvent(new KeyboardEvent('keydown', {key: ' ', bubbles: true}))")
    page.until(page.elbow_is(0.9))


def test_steps_and_reset_in_direct_mode(page: Page) -> None:
    choose = "const m = document.querySelector('#mode'); m.value = '{}'; m.dispatchEvent(new Event('change'))"
    page.driver.execute_script(choose.format("direct"))
    page.click("#reset")
    page.until("parseFloat(document.querySelector('#time').textContent) === 0")
    page.driver.execute_script("document.querySelector('#steps').value = 50")
    page.click("#step")
    page.until("document.querySelector('#time').textContent === '0.10 s'")
    page.driver.execute_script(choose.format("live"))
    page.until(RUNNING)


def test_a_second_viewer_drives_only_when_the_first_lets_go(page: Page, tmp_path: Path) -> None:
    page.slide(0.2)
    page.until("document.querySelector('#driver').dataset.who === 'me'")
    with opened(tmp_path, page.invitation()) as second:
        second.until("document.querySelector('#driver')?.dataset.who === 'other'")
        assert second.look("document.querySelector('#drive').disabled")
        second.slide(0.8)
        second.until("document.querySelector('#toasts').innerText.includes('has the controls')")
        page.until(page.elbow_is(0.2))
        page.click("#drive")
        second.until("document.querySelector('#driver').dataset.who === 'free'")
        second.slide(0.8)
        page.until(page.elbow_is(0.8))
        page.until("document.querySelector('#driver').dataset.who === 'other'")


def test_the_3d_view_shows_the_robot_and_follows_it(page: Page, tmp_path: Path) -> None:
    page.until("document.querySelector('#view').innerText.includes('no WebGL')")
    page.slide(0.0)
    page.until(page.elbow_is(0.0))
    with opened(tmp_path, page.invitation(), (*SOLID, "--window-size=1000,500")) as one:
        one.driver.execute_script("window.scrollTo(0, 0)")
        stage = one.driver.find_element("css selector", ".stage")

        def picture() -> np.ndarray[Any, Any]:
            return np.asarray(Image.open(io.BytesIO(stage.screenshot_as_png)).convert("RGB"), dtype=np.float64)

        def differ(one: np.ndarray[Any, Any], other: np.ndarray[Any, Any]) -> float:
            return float((np.abs(one - other).max(axis=2) > 30).mean())

        def blue() -> bool:  # as parts of the arm are, and nothing else
            return bool(((picture() @ [-1.0, -0.5, 1.0]) > 60).mean() > 0.003)

        wait = WebDriverWait(one.driver, PATIENCE_S, 0.3)
        wait.until(lambda _: blue(), "the arm never appeared")
        before = picture()
        page.slide(1.2)
        wait.until(lambda _: differ(before, picture()) > 0.005, "the arm never moved")


def test_a_killed_server_shows_as_such_and_comes_back(
    page: Page, console: tuple[dict[str, Any], str, contextlib.ExitStack]
) -> None:
    ready, _, stack = console
    page.until(RUNNING)
    stack.close()  # kills it
    page.until("!document.querySelector('#banner').hidden && document.body.dataset.link === 'lost'")
    page.until("document.body.classList.contains('stale')")
    ports = [f"--{n}-port={ready[f'{n}_port']}" for n in ("step", "state", "ctrl", "info", "camera")]
    stack.enter_context(serve(*ports))
    page.until("document.body.dataset.link === 'connected' && document.querySelector('#banner').hidden")
    page.until(RUNNING)
    page.slide(0.4)
    page.until(page.elbow_is(0.4))
