"""The 3-D view of the console's page, as the eye and the mouse have it."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import numpy as np
from console_page import PATIENCE_S, Page
from numpy.typing import NDArray
from PIL import Image
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.support.ui import WebDriverWait

__all__ = ["INTO_VIEW", "View"]

INTO_VIEW = "document.querySelector('.stage').scrollIntoView({block: 'center', behavior: 'instant'})"
Picture = NDArray[np.float64]


class View:
    """The 3-D view of a page."""

    def __init__(self, page: Page) -> None:
        self.page = page
        # A screenshot gets 10 seconds, which may be too few where the processor draws and has other things to do.
        self._wait = WebDriverWait(page.driver, PATIENCE_S, 0.3, ignored_exceptions=[TimeoutException])

    def picture(self) -> Picture:
        self.page.driver.execute_script(INTO_VIEW)
        (taken,) = self._wait.until(lambda _: [self.page.find(".stage").screenshot_as_png], "no picture")
        return np.asarray(Image.open(io.BytesIO(taken)).convert("RGB"), dtype=np.float64)

    def until_picture(self, wanted: Callable[[Picture], Any], problem: str) -> None:
        self._wait.until(lambda _: bool(wanted(self.picture())), problem)

    def until_the_arm_is_seen(self) -> None:
        # Blue, as parts of the arm are, and nothing else.
        self.until_picture(lambda seen: ((seen @ [-1.0, -0.5, 1.0]) > 60).mean() > 0.001, "the arm never appeared")

    def until_it_differs(self, before: Picture, problem: str) -> None:
        self.until_picture(lambda seen: _share_that_differs(seen, before) > 0.0003, problem)

    def until_it_is(self, before: Picture, problem: str) -> None:
        self.until_picture(lambda seen: _share_that_differs(seen, before) < 0.0001, problem)

    def place_of(self, robot: str) -> tuple[float, float, int]:
        """Return where a body of a robot is in the picture, in pixels, and its number."""
        found = self.page.driver.execute_async_script(
            "const [robot, done] = arguments; const frame = document.querySelector('#view iframe');"
            "import('/static/link.js').then(async ({ask}) => { for (let y = 0.2; y < 0.9; y += 0.04)"
            "for (let x = 0.1; x < 0.9; x += 0.04) { const {innerWidth: w, innerHeight: h} = frame.contentWindow;"
            "const ray = frame.contentWindow.eval(`viewerPointer.ray(${x * w}, ${y * h})`);"
            "const found = await ask('POST', 'api/pick', ray, {quiet: true});"
            "if (found?.body?.robot === robot) return done([x * w, y * h, found.body.id]); } done(null); })",
            robot,
        )
        assert found, f"{robot} is not in the picture"
        return found[0], found[1], found[2]

    def pointer(self, kind: str, x: float, y: float, **keys: bool) -> None:
        self.page.driver.execute_script(
            "const [type, x, y, keys] = arguments;"
            "const {contentWindow: view} = document.querySelector('#view iframe');"
            "view.document.body.dispatchEvent(new view.PointerEvent("
            "type, {clientX: x, clientY: y, button: 0, pointerId: 1, bubbles: true, cancelable: true, ...keys}))",
            kind, x, y, keys,
        )  # fmt: skip

    def select(self, robot: str) -> tuple[float, float, int]:
        """Click a body of a robot; return where it is, and its number."""
        x, y, body = self.place_of(robot)
        for kind in ("pointerdown", "pointerup"):
            self.pointer(kind, x, y)
        self.page.until(f"+document.querySelector('#body').value === {body}")
        self.page.until("document.querySelector('#body-facts').textContent.includes('kg')")
        return x, y, body


def _share_that_differs(one: Picture, other: Picture) -> float:
    return float((np.abs(one - other).max(axis=2) > 30).mean())
