"""A browser before `urlab console`, as a person has it."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

__all__ = ["PATIENCE_S", "PHONE", "RUNNING", "SLIDER", "SOLID", "Page", "command", "link_in", "opened", "serve"]

FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--window-size=1300,900",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
FLAT = ("--disable-gpu", "--disable-3d-apis")
SOLID = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")  # WebGL without a graphics card
PATIENCE_S = 120
"""Only there so that nothing hangs: a busy machine without a graphics card takes seconds for a picture."""

RUNNING = "document.querySelector('#play').textContent.includes('Pause')"
SLIDER = "[data-robot=arm] [data-actuator=elbow]"

VIOLATIONS = """window.violations = [];
document.addEventListener("securitypolicyviolation", ({violatedDirective, blockedURI}) =>
  window.violations.push(`${violatedDirective}: ${blockedURI}`));
window.addEventListener("error", ({message}) => window.violations.push(message));
window.addEventListener("unhandledrejection", ({reason}) => window.violations.push(String(reason)));"""
"""Collects in each page and frame what its security policy refuses, and errors that no code handles."""

PHONE = {"width": 360, "height": 740, "deviceScaleFactor": 2, "mobile": True}


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
    return command(
        "serve", "arm", "quadruped", "--controller", "quadruped=pd,kp=40,kv=1.5", "--play", "--unpaused", "--json",
        "--camera-size", "64x48", *ports,
    )  # fmt: skip


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

    def choose(self, selector: str, value: str) -> None:
        self.driver.execute_script(
            "const [selector, value] = arguments; const list = document.querySelector(selector);"
            "list.value = value; list.dispatchEvent(new Event('change'))",
            selector, value,
        )  # fmt: skip

    def find(self, selector: str) -> WebElement:
        return self.driver.find_element("css selector", selector)

    def ask(self, path: str, body: object = None) -> Any:
        """Ask the console as the page does."""
        return self.driver.execute_async_script(
            "const [path, body, done] = arguments; import('/static/link.js').then(({ask}) => "
            "ask(body === null ? 'GET' : 'POST', path, body ?? undefined)).then(done)",
            path, body,
        )  # fmt: skip

    def asked(self, path: str, wanted: Callable[[Any], object], body: object = None) -> None:
        """Ask until the answer is as wanted."""
        WebDriverWait(self.driver, PATIENCE_S, 0.05).until(lambda _: wanted(self.ask(path, body)), f"never: {path}")

    def unfold(self, robot: str, title: str) -> None:
        self.driver.execute_script(
            "[...document.querySelectorAll(`[data-robot=${arguments[0]}] details`)]"
            ".find(one => one.firstChild.textContent === arguments[1]).open = true",
            robot, title,
        )  # fmt: skip

    def slide(self, value: float) -> None:
        self.driver.execute_script(
            "const slider = document.querySelector(arguments[0]); slider.value = arguments[1];"
            "slider.dispatchEvent(new Event('input', {bubbles: true}))",
            SLIDER, value,
        )  # fmt: skip

    def troubles(self) -> list[str]:
        """Return what the policies of the page and its frames refused, and errors in its programs."""
        found = self.look(
            "[window, ...[...document.querySelectorAll('iframe')].map(one => one.contentWindow)]"
            ".flatMap(one => one.violations ?? [])"
        )
        # A refused request is also an error to the browser; the page tells its user of those.
        log = self.driver.get_log("browser")
        return [*found, *(one["message"] for one in log if one["level"] == "SEVERE" and one["source"] != "network")]

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

    def curve(self, key: str, signal: str, seconds: int = 30) -> list[float]:
        """Return what the pointer reads of a signal along the curves with a key, from left to right.

        30 s are long enough for a slow machine, whose simulation goes on while a test asks its page.
        """
        self.choose("#span", str(seconds))
        # Curves out of sight are not drawn: the page sees that they are in sight just before `seen` does.
        read: list[str] = self.driver.execute_async_script(
            "const [key, signal, done] = arguments; const one = document.querySelector(`[data-sensor='${key}']`);"
            "one.scrollIntoView({block: 'center'}); const box = one.querySelector('canvas').getBoundingClientRect();"
            "const shown = [...one.querySelectorAll('.signal')].find(one => one.children[1].textContent === signal);"
            "const painted = () => new Promise(go => requestAnimationFrame(() => requestAnimationFrame(go)));"
            "const seen = new Promise(go => new IntersectionObserver(go).observe(one.querySelector('canvas')));"
            "(async () => { await seen; const read = []; for (let share = 0; share <= 1; share += 1 / 64) {"
            "one.querySelector('canvas').dispatchEvent(new PointerEvent('pointermove',"
            "{clientX: box.left + 48 + share * (box.width - 56), clientY: box.top + 20}));"
            "await painted(); read.push(shown.querySelector('.num').textContent); }"
            "one.querySelector('canvas').dispatchEvent(new PointerEvent('pointerleave')); done(read); })()",
            key, signal,
        )  # fmt: skip
        return [float(one.replace("\u2212", "-")) for one in read if one]

    def phone(self) -> contextlib.AbstractContextManager[None]:
        """Be as small as a phone for a while, and touched instead of clicked."""

        @contextlib.contextmanager
        def held() -> Iterator[None]:
            self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", PHONE)
            self.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
            try:
                self.until(f"innerWidth === {PHONE['width']}")
                yield
            finally:
                self.driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": False})
                self.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})

        return held()


def link_in(line: str) -> str:
    """Return the link that `urlab console` printed."""
    return next(word for word in line.split() if word.startswith("http://"))


@contextlib.contextmanager
def opened(folder: Path, link: str, flags: tuple[str, ...] = FLAT) -> Iterator[Page]:
    options = Options()
    options.binary_location = "/usr/bin/chromium"
    for flag in (*FLAGS, *flags, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options, Service("/usr/bin/chromedriver"))
    driver.set_script_timeout(PATIENCE_S)
    try:
        driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": VIOLATIONS})
        driver.get(link)
        page = Page(driver)
        yield page
        troubles = page.troubles()
        assert troubles == [], troubles
    finally:
        driver.quit()
