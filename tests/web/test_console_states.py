"""The console's page while things go wrong around it, in a real Chromium that draws the 3-D view."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from console_page import PHONE, RUNNING, SLIDER, SOLID, Page, command, link_in, opened
from console_view import View
from selenium.webdriver.common.action_chains import ActionChains

pytestmark = pytest.mark.browser

COVER = "document.querySelector('#view .cover')"
MODEL = "document.querySelector('.stage iframe')?.contentWindow.eval('currentModelCrc')"
PRESS = "document.querySelector(arguments[0]).click()"
CONFIRM = """(() => {  // in one go: the question lasts four seconds, which a busy machine may take between two calls
  const button = document.querySelector('#restart');
  const asked = button.textContent.includes('?');
  button.click();
  return asked;
})()"""
UNFADED = """for (const [name, value] of [["transition", "none"], ["opacity", "1"], ["filter", "none"]])
  document.querySelector("main").style.setProperty(name, value, "important")"""


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[subprocess.Popen[str], Page]]:
    """The process of a console whose server has an arm but does not play, and its page."""
    ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    with contextlib.ExitStack() as stack:
        _, line = stack.enter_context(command("serve", "arm", "--json", "--camera-size", "64x48", *ports))
        ready = json.loads(line)
        ours = [f"--step-port={ready['step_port']}", f"--state-port={ready['state_port']}", "--port=0"]
        process, said = stack.enter_context(command("console", ready["address"], *ours))
        flags = (*SOLID, "--window-size=1000,1000")
        yield process, stack.enter_context(opened(tmp_path_factory.mktemp("page"), link_in(said), flags))


@pytest.fixture(scope="module")
def page(console: tuple[subprocess.Popen[str], Page]) -> Page:
    return console[1]


def drawn(page: Page) -> View:
    page.until(f"{COVER}?.hidden === true")
    view = View(page)
    view.until_the_arm_is_seen()
    return view


def begin_play(page: Page) -> None:
    page.until("document.querySelector('#restart')?.textContent === 'Begin play'")
    page.driver.execute_script(PRESS, "#restart")
    page.until(f"document.querySelector('{SLIDER}') !== null")


@pytest.fixture
def playing(page: Page) -> Page:
    """The page of the console whose server plays; the tests of this file may run in several processes."""
    page.until("['Begin play', 'Restart'].some(one => document.querySelector('#restart')?.textContent.includes(one))")
    if page.look("document.querySelector('#restart').textContent") == "Begin play":
        begin_play(page)
    return page


def test_the_3d_view_says_what_it_waits_for_and_loads_when_there_is_a_model(page: Page) -> None:
    page.until(f"{COVER}?.innerText.includes('begin play')")
    begin_play(page)
    drawn(page)


def test_the_3d_view_shows_the_next_model(playing: Page) -> None:
    page = playing
    first = page.look(MODEL)
    blueprint = page.look("document.querySelector('#blueprint').value")
    assert page.ask("api/ops/spawn_actor", {"blueprint": blueprint, "actor_id": "second", "location": [0, 2, 0]})
    page.driver.execute_script(PRESS, "#restart")
    page.until("document.querySelector('#restart').textContent.includes('?')")
    assert page.look(MODEL) == first, "it asks before it throws a simulation away"
    page.until(CONFIRM)
    page.until("document.querySelectorAll('[data-robot]').length === 2")
    page.until(f"({MODEL} ?? 0) > 0 && {MODEL} !== {first}")
    drawn(page)


def test_keys_are_the_consoles_after_a_click_into_the_3d_view(playing: Page) -> None:
    page = playing
    drawn(page)
    page.driver.execute_script("window.scrollTo(0, 0)")

    def press(key: str) -> None:
        ActionChains(page.driver).move_to_element(page.find(".stage")).click().send_keys(key).perform()

    page.until(f"!({RUNNING})")
    press(" ")
    page.until(RUNNING)
    press("\ue00c")  # escape
    page.until(f"!({RUNNING})")
    who = page.look("document.querySelector('#driver').dataset.who")
    press("d")
    page.until(f"document.querySelector('#driver').dataset.who !== '{who}'")
    page.ask("api/lease", {})


def test_the_3d_view_fills_the_screen_with_its_tools(playing: Page) -> None:
    page = playing
    drawn(page)
    page.driver.execute_script("window.scrollTo(0, 0)")
    full = page.find("#view [title='Full screen']")
    full.click()
    page.until("document.fullscreenElement?.matches('.screen')")
    boxes = [
        page.look(f"document.querySelector('{one}').getBoundingClientRect().toJSON()") for one in ("#fit", ".stage")
    ]
    assert 0 <= boxes[0]["top"] < boxes[0]["bottom"] <= boxes[1]["top"]
    assert boxes[1]["height"] > 0.8 * page.look("innerHeight")
    assert boxes[1]["bottom"] == pytest.approx(page.look("innerHeight"), abs=1)
    full.click()
    page.until("document.fullscreenElement === null")


def test_a_list_gives_the_keyboard_back(playing: Page) -> None:
    page = playing
    page.driver.execute_script(
        "const mode = document.querySelector('#mode'); mode.focus();"
        "mode.dispatchEvent(new Event('change', {bubbles: true}))"
    )
    assert page.look("document.activeElement === document.body")


def test_nobody_removes_the_manager_and_a_level_without_one_offers_it(playing: Page) -> None:
    page = playing
    page.until("document.querySelector('[data-actor]') !== null")
    shown = page.look("[...document.querySelectorAll('[data-actor]')].map(one => one.dataset.actor)")
    actors = page.ask("api/ops/list_actors", {})["actors"]
    manager = next(actor["name"] for actor in actors if "Manager" in actor["class"])
    assert manager not in shown
    assert page.look("document.querySelector('#no-manager').hidden")
    page.ask("api/ops/destroy_actor", {"target": manager, "target_by": "actor_name"})
    page.until("!document.querySelector('#no-manager').hidden")
    page.driver.execute_script(PRESS, "#add-manager")
    page.until("document.querySelector('#no-manager').hidden")
    assert any("Manager" in actor["class"] for actor in page.ask("api/ops/list_actors", {})["actors"])


def test_the_page_asks_before_a_model_replaces_another(page: Page, tmp_path: Path) -> None:
    (tmp_path / "crate.xml").write_text("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>")
    names = "[...document.querySelectorAll('#blueprint option')].map(one => one.text)"
    for _ in range(2):
        page.until("document.querySelector('#would-replace')?.hidden === true")
        page.find("#model-file").send_keys(str(tmp_path / "crate.xml"))
        page.until(f"{names}.includes('crate')")
    page.until("!document.querySelector('#would-replace').hidden")
    asked = page.find("#would-replace").text
    assert "There is already a blueprint 'crate'" in asked
    assert "Replace crate" in asked
    page.driver.execute_script(PRESS, "#would-replace button")
    page.until("document.querySelector('#would-replace').hidden")
    page.asked("api/log", lambda entries: [entry["what"] for entry in entries].count("import model") == 2)


def test_no_message_covers_stop_on_a_phone(page: Page) -> None:
    with page.phone():
        for op in ("one_that_is_not", "nor_this", "and_not_this"):
            page.ask(f"api/ops/{op}", {})
        page.until("document.querySelectorAll('.toast').length >= 3")
        boxes = page.look("[...document.querySelectorAll('.toast')].map(one => one.getBoundingClientRect().toJSON())")
        stop = page.look("document.querySelector('#stop').getBoundingClientRect().toJSON()")
        for box in boxes:
            apart = box["right"] <= stop["left"] or stop["right"] <= box["left"]
            assert apart or box["bottom"] <= stop["top"] or stop["bottom"] <= box["top"], (box, stop)
            assert 0 <= box["left"] < box["right"] <= PHONE["width"]


def test_a_console_that_stands_still_or_ends_shows_as_such_and_only_once(
    console: tuple[subprocess.Popen[str], Page], playing: Page
) -> None:
    process, page = console[0], playing
    drawn(page)
    gone = (
        "document.querySelector('#link').textContent === 'No console' && document.body.dataset.link === 'gone' "
        "&& ['#play', '#stop', '#reset', '#drive'].every(one => document.querySelector(one).closest('[inert]')) "
        "&& document.querySelector('main').inert && document.body.classList.contains('stale')"
    )
    process.send_signal(signal.SIGSTOP)
    try:
        page.until(gone)
    finally:
        process.send_signal(signal.SIGCONT)
    page.until("document.querySelector('#link').textContent === 'Connected' && !document.querySelector('main').inert")
    view = drawn(page)
    before = view.picture()
    process.kill()
    page.until(gone)
    page.until("document.querySelector('#banner').innerText.includes('for 3 s')")
    # The viewer would now cover the picture with a message of its own, as if there were two things wrong.
    page.driver.execute_script(UNFADED)
    page.driver.execute_script("document.querySelector('#banner').style.display = 'none'")  # it lies over the page
    assert (np.abs(view.picture() - before).max(axis=2) > 30).mean() < 0.01
