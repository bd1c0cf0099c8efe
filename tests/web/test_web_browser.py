"""The page in a real Chromium: `urlab console` before it, `urlab serve` behind that."""

from __future__ import annotations

import base64
import contextlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from console_page import PATIENCE_S, PHONE, RUNNING, SLIDER, SOLID, Page, command, link_in, opened, serve
from console_view import View
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import WebDriverWait

from urlab_client.integrations.record import read_run

FRAME = "document.querySelector('#view iframe')"

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]  # drawing without a graphics card takes its time

TOO_WIDE = """[...document.querySelectorAll('main *, header *')]
  .filter((one) => !one.closest('.frame, .entries, .actors, .recordings'))
  .filter((one) => one.getBoundingClientRect().right > innerWidth + 1)
  .map((one) => one.outerHTML.slice(0, 80))"""


@pytest.fixture(scope="module")
def console(
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[dict[str, Any], str, contextlib.ExitStack]]:
    """A server, the link to a console before it, and what holds the server."""
    with contextlib.ExitStack() as stack:
        _, line = stack.enter_context(serve(*(f"--{n}-port=0" for n in ("step", "state", "ctrl", "info", "camera"))))
        ready = json.loads(line)
        with command(
            "console", ready["address"], f"--step-port={ready['step_port']}", f"--state-port={ready['state_port']}",
            "--port=0", f"--recordings={tmp_path_factory.mktemp('recordings')}",
        ) as (_, said):  # fmt: skip
            yield ready, link_in(said), stack


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


@pytest.mark.opengl
def test_cameras_and_curves_are_drawn(page: Page) -> None:
    page.until("document.querySelectorAll('#cameras .camera').length === 4")
    page.driver.execute_script("document.querySelector('#cameras').scrollIntoView()")  # only what is seen is streamed
    page.until("[...document.querySelectorAll('#cameras .camera')].every(one => /fps/.test(one.innerText))")
    pixels = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    drawn = f"(canvas => {pixels}.some((value, i) => i % 4 === 1 && value > 90))"  # in colours, not in black
    page.driver.execute_script("document.querySelector('.curve').scrollIntoView()")
    page.until(f"{drawn}(document.querySelector('.curve canvas'))")


GAMEPAD = """
window.pad = {id: 'Pad', connected: true, mapping: 'standard', axes: [0, 0, 0, 0],
  buttons: Array.from({length: 17}, () => ({pressed: false, value: 0}))};
navigator.getGamepads = () => [null, window.pad];
"""


def test_keys_and_a_gamepad_move_the_hand_and_judge_episodes(page: Page) -> None:
    def hand() -> list[float]:
        return page.ask("api/state")["articulations"]["arm"]["sensors"]["grip_position"]

    def key(kind: str, code: str) -> None:
        page.driver.execute_script(
            "document.body.dispatchEvent(new KeyboardEvent(arguments[0], {code: arguments[1], bubbles: true}))",
            kind,
            code,
        )

    page.until(RUNNING)
    page.ask("api/ops/reset", {})
    page.asked("api/state", lambda state: state["time"] < 1.0)
    page.click("#record")
    page.until("document.querySelector('[data-outcome=success]').disabled === false")
    page.click("#drive-hand")
    page.until("/^Keys W S A D R F move it.* No gamepad/.test(document.querySelector('#gamepad').textContent)")
    before = hand()
    key("keydown", "KeyA")
    WebDriverWait(page.driver, PATIENCE_S, 0.05).until(lambda _: hand()[1] > before[1] + 0.05)
    key("keyup", "KeyA")
    page.driver.execute_script(GAMEPAD)
    page.until("/^Keys .* Gamepad: Pad\\.$/.test(document.querySelector('#gamepad').textContent)")
    page.driver.execute_script("window.pad.axes = [0.1, 0, 0, 1]")  # within the dead zone, and down
    WebDriverWait(page.driver, PATIENCE_S, 0.05).until(lambda _: hand()[2] < before[2] - 0.05)
    page.driver.execute_script("window.pad.axes = [0, 0, 0, 0]; window.pad.buttons[0] = {pressed: true, value: 1}")
    page.asked("api/state", lambda state: state["time"] < 1.0)  # a success, and reset
    page.until("document.querySelector('#log').innerText.includes('success')")
    page.driver.execute_script("window.pad.buttons[0] = {pressed: false, value: 0}")
    page.click("#drive-hand")
    page.click("#record")
    page.until("document.querySelector('#record').textContent.includes('Record')")
    page.until("document.querySelectorAll('.recorded').length === 1")
    page.driver.execute_script(
        "const name = document.querySelector('.recorded').dataset.recording;"
        "import('/static/link.js').then(({ask}) => ask('DELETE', `api/recordings/${name}`))"
    )
    page.until("document.querySelectorAll('.recorded').length === 0")


def test_the_stop_button_stops_and_space_goes_on(page: Page) -> None:
    page.until(RUNNING)
    page.click("#stop")
    page.until(f"!({RUNNING})")
    page.slide(0.9)
    page.until("document.querySelector('#log').innerText.includes('paused physics')")
    page.until("document.querySelector('#age').innerText === 'paused'")
    assert not page.look("document.querySelector('#age').classList.contains('old')")
    assert not page.look(page.elbow_is(0.9))
    page.driver.execute_script("document.body.dispatchEvent(new KeyboardEvent('keydown', {key: ' ', bubbles: true}))")
    page.until(page.elbow_is(0.9))


def test_steps_and_reset_in_direct_mode(page: Page) -> None:
    page.choose("#mode", "direct")
    page.until("!document.querySelector('#step').disabled")
    page.click("#reset")
    page.until("parseFloat(document.querySelector('#time').textContent) === 0")
    page.driver.execute_script("document.querySelector('#steps').value = 50")
    page.click("#step")
    page.until("document.querySelector('#time').textContent === '0.10 s'")
    page.choose("#mode", "live")
    page.until("document.querySelector('#step').disabled")
    page.until("document.querySelector('#age').innerText === 'paused'")
    assert not page.look(RUNNING), "nobody pressed Play"
    page.click("#play")
    page.until(RUNNING)


def test_one_row_sets_the_gains_of_all_actuators(page: Page) -> None:
    page.unfold("quadruped", "Gains")
    one, other = (f"document.querySelector('[data-gain=\"kp/{name}\"]').value" for name in ("all", "RR_calf"))
    page.until(f"{one} === '40'")
    for value in ("35", "40"):
        box = page.find("[data-gain='kp/all']")
        box.send_keys(Keys.CONTROL, "a")
        box.send_keys(value, Keys.ENTER)
        page.until(f"{other} === '{value}'")
    page.until("document.querySelector('#log').innerText.includes('set kp of quadruped: 40 for 12 actuators')")


def test_gains_are_tuned_by_typing_and_the_next_box_keeps_the_focus(page: Page) -> None:
    def params() -> Any:
        robots = {art["key"]: art for art in page.ask("api/world")["articulations"]}
        return robots["quadruped"]["controller"]["params"]

    page.unfold("quadruped", "Gains")
    box = page.find("[data-gain='kp/FL_hip']")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("55", Keys.TAB)
    following = page.driver.switch_to.active_element
    assert following.get_attribute("data-gain") == "kv/FL_hip"
    following.send_keys(Keys.CONTROL, "a")
    following.send_keys("2")
    page.asked("api/world", lambda _: params()["kp"]["FL_hip"] == 55)
    following.send_keys(".5", Keys.ENTER)
    page.asked("api/world", lambda _: params()["kv"]["FL_hip"] == 2.5)
    assert following == page.driver.switch_to.active_element
    assert params()["kp"]["FR_hip"] == 40


def test_a_gain_that_is_refused_goes_back_to_what_it_was(page: Page) -> None:
    program = "fetch('api/lease', {{method: '{}'}}).then(answer => arguments[0](answer.status))"
    page.asked("api/lease", lambda status: status["mine"], {})
    page.click("#drive")
    page.until("document.querySelector('#driver').dataset.who === 'free'")
    assert page.driver.execute_async_script(program.format("POST")) == 200
    page.until("document.querySelector('#driver').textContent.includes('a program drives')")
    page.unfold("quadruped", "Gains")
    box = page.find("[data-gain='kp/RL_hip']")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("70", Keys.ENTER)
    page.until("document.querySelector('#toasts').innerText.includes('has the controls')")
    page.until("document.querySelector('[data-gain=\"kp/RL_hip\"]').value === '40'")
    assert page.driver.execute_async_script(program.format("DELETE")) == 200


def test_the_twist_pad_commands_while_a_key_is_held(page: Page) -> None:
    page.unfold("quadruped", "Commanded twist")
    pad = page.find("[data-robot=quadruped] .pad")
    page.driver.execute_script("arguments[0].scrollIntoView({block: 'center'}); arguments[0].focus()", pad)
    ActionChains(page.driver).key_down("w").perform()
    page.asked("api/status", lambda status: status["twists"].get("quadruped") == [0.5, 0, 0])
    ActionChains(page.driver).key_up("w").perform()
    page.asked("api/status", lambda status: status["twists"].get("quadruped") == [0, 0, 0])
    ActionChains(page.driver).move_to_element_with_offset(pad, 0, -64 + 16).click_and_hold().perform()
    page.asked("api/status", lambda status: status["twists"]["quadruped"][0] > 0.5)
    ActionChains(page.driver).release().perform()
    page.asked("api/status", lambda status: status["twists"]["quadruped"] == [0, 0, 0])


def test_actors_are_spawned_moved_and_removed_and_nobody_loses_what_they_type(page: Page) -> None:
    def where(actor: str) -> Any:
        actors = page.ask("api/ops/list_actors", {})["actors"]
        return next((one["location"] for one in actors if one["actor_id"] == actor), None)

    page.until("document.querySelector('#blueprint').options.length > 0")
    page.find("#actor-id").send_keys("second")
    page.find("#spawn").click()
    page.until("document.querySelector('[data-actor=second]') !== null")
    x = page.find("[data-actor=second] input")
    x.send_keys(Keys.CONTROL, "a")
    x.send_keys("1.5")
    blueprint = page.look("document.querySelector('#blueprint').value")
    page.ask("api/ops/spawn_actor", {"blueprint": blueprint, "actor_id": "third", "location": [0, 2, 0]})
    page.until("document.querySelector('[data-actor=third]') !== null")
    assert x == page.driver.switch_to.active_element
    assert x.get_attribute("value") == "1.5"
    page.find("[data-actor=second] [aria-label='Move second']").click()
    page.asked("api/ops/list_actors", lambda _: where("second")[0] == 1.5, {})
    for actor in ("second", "third"):
        remove = page.find(f"[data-actor={actor}] button[title^=Remove]")
        remove.click()
        assert remove.text == "Remove?"
        assert where(actor) is not None, "what cannot be taken back is asked for first"
        # At once: it does not wait long for an answer, and this machine may be busy.
        confirm = "const [button] = arguments; if (button.textContent !== 'Remove?') button.click(); button.click()"
        page.driver.execute_script(confirm, remove)
        page.until(f"document.querySelector('[data-actor={actor}]') === null")
        assert where(actor) is None


@pytest.mark.opengl
def test_a_recording_is_made_offered_for_download_and_replayed_in_seconds(page: Page, tmp_path: Path) -> None:
    page.until(RUNNING)
    page.slide(0.0)
    page.until(page.elbow_is(0.0))
    page.click("#record")
    page.until("document.querySelector('#record').textContent.includes('Stop')")
    page.slide(0.9)
    page.until(page.elbow_is(0.9))
    page.asked("api/status", lambda status: status["recording"]["pictures"] >= 4 and status["recording"]["seconds"] > 3)
    page.click("#record")
    page.until("document.querySelectorAll('[data-recording]').length === 1")
    page.driver.execute_script("document.querySelector('[data-recording] .menu').open = true")
    page.until("document.querySelector('[data-recording] .kinds').innerText.includes('MP4, arm/overview')")
    kinds = page.look(
        "[...document.querySelectorAll('[data-recording] .kind')].map(one => one.textContent.split(',')[0])"
    )
    assert {"MCAP", "CSV", "MP4"} <= set(kinds)
    for at in (0, 1):
        size = "fetch(arguments[0]).then(one => one.blob()).then(one => arguments[1](one.size))"
        link = page.look(f"document.querySelectorAll('[data-recording] .kind')[{at}].href")
        assert page.driver.execute_async_script(size, link) > 1000
    read = (
        "const [link, done] = arguments; const reader = new FileReader(); reader.onload = () => done(reader.result);"
        "fetch(link).then(one => one.blob()).then(one => reader.readAsDataURL(one))"
    )
    link = page.look("document.querySelector('[data-recording] .kind').href")
    file = tmp_path / "run.mcap"
    file.write_bytes(base64.b64decode(page.driver.execute_async_script(read, link).partition(",")[2]))
    run = read_run(file)
    start, end = run.time_range()
    times = [picture.time - start for picture in run.frames("arm/overview") if picture.time < end + 1e-6]
    page.click("#stop")
    page.until(f"!({RUNNING})")
    shown = page.look(
        "(one => [one.dataset.sensor, one.querySelector('.signal').children[1].textContent])"
        "(document.querySelector('.curve'))"
    )
    before = page.curve(*shown)
    assert len({*before}) > 1
    page.click("[data-recording] .replay")
    page.until("!document.querySelector('#replay').hidden && +document.querySelector('#timeline').value > 0.1")
    page.until("document.querySelector('#time').textContent !== '0.00 s'")
    page.driver.execute_script("document.querySelector('#cameras').scrollIntoView({block: 'center'})")
    page.until("document.querySelector('[data-camera=\"arm/overview\"] .origin').textContent === 'recorded'")
    strip = page.look("document.querySelector('#replay').getBoundingClientRect().top")
    assert strip >= page.look("document.querySelector('#bar').getBoundingClientRect().bottom - 1"), "in sight, scrolled"
    assert page.look("document.querySelector('#robots').inert"), "what drives would do so unseen"
    seconds = page.look("+document.querySelector('#timeline').max")
    page.click("#stop")  # whatever moves, physics as well
    page.until("document.querySelector('#replay-play').textContent === '▶'")
    go = (
        "const t = document.querySelector('#timeline'); t.value = arguments[0] * t.max;"
        "t.dispatchEvent(new Event('input', {bubbles: true}))"
    )
    pictured = "parseFloat(document.querySelector('[data-camera=\"arm/overview\"] .num').textContent.slice(3))"
    for share, elbow in ((1.0, 0.9), (0.0, 0.0), (1.0, 0.9)):
        page.driver.execute_script(go, share)
        page.until(page.elbow_is(elbow))
        page.until(f"Math.abs(parseFloat(document.querySelector('#time').textContent) - {share * seconds}) < 0.1")
        page.until(f"Math.abs({pictured} - {times[-1] if share else times[0]}) < 0.006")
    page.find("body").send_keys(" ")
    page.until("document.querySelector('#replay-play').textContent === '❚❚'")
    page.click("#replay-end")
    page.until("document.querySelector('#replay').hidden")
    assert not page.look(RUNNING), "it was stopped, and what the replay showed was not its time"
    assert page.curve(*shown) == before, "what came before the replay is back"
    page.click("#play")
    page.until(RUNNING)
    remove = page.find("[data-recording] button[aria-label^=Delete]")
    remove.click()
    remove.click()
    page.until("document.querySelectorAll('[data-recording]').length === 0")


def test_keys_work_and_not_while_somebody_types(page: Page) -> None:
    body = page.find("body")
    page.slide(0.0)  # whoever acts drives
    page.driver.execute_script("document.activeElement.blur()")
    page.until("document.querySelector('#driver').dataset.who === 'me'")
    body.send_keys("d")
    page.until("document.querySelector('#driver').dataset.who === 'free'")
    body.send_keys("d")
    page.until("document.querySelector('#driver').dataset.who === 'me'")
    body.send_keys("?")
    page.until("document.querySelector('#help').open")
    page.find("#help button").click()
    page.until("!document.querySelector('#help').open")
    # As Chromium sends it where nothing has the focus: to the document, which is not an element.
    page.driver.execute_script("document.dispatchEvent(new KeyboardEvent('keydown', {key: '?'}))")
    page.until("document.querySelector('#help').open")
    page.find("#help button").click()
    field = page.find("#actor-id")
    field.clear()
    field.send_keys("d ?")
    assert field.get_attribute("value") == "d ?"
    field.clear()
    assert page.look("document.querySelector('#driver').dataset.who") == "me"
    assert not page.look("document.querySelector('#help').open")


def test_it_fits_a_phone(page: Page) -> None:
    with page.phone():
        page.unfold("quadruped", "Gains")
        page.unfold("quadruped", "Joints")
        for place in (0, 1):
            page.driver.execute_script(f"window.scrollTo(0, {place} * document.body.scrollHeight)")
            wide = page.look(TOO_WIDE)
            assert wide == []
            assert page.look("document.documentElement.scrollWidth") == PHONE["width"]
            stop = page.look("document.querySelector('#stop').getBoundingClientRect().toJSON()")
            assert 0 <= stop["top"] <= stop["bottom"] <= PHONE["height"]
            assert stop["height"] >= 44


def test_the_joint_panel_takes_numbers_and_goes_to_zero_and_home(page: Page) -> None:
    row = "[data-robot=arm] [data-actuator=elbow]"
    page.driver.execute_script("document.querySelector('[data-robot=arm]').scrollIntoView()")
    box = page.find("[data-robot=arm] [data-set-point=elbow]")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("0.7", Keys.ENTER)
    page.until(page.elbow_is(0.7))
    assert page.look("document.querySelector('[data-robot=arm] [data-value=elbow]').textContent.endsWith(' rad')")
    limits = page.look(f"document.querySelector('{row}').parentElement.innerText.split(/\\s+/)")
    assert limits == ["\u22121.4", "2.62"]
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("99", Keys.ENTER)
    page.until(f"document.querySelector('{row}').value > 2.5")  # as far as its limit
    page.click('[data-robot=arm] [aria-label="elbow to 0"]')
    page.until(page.elbow_is(0.0))
    page.click('[data-robot=arm] [aria-label="All home"]')
    homes = {one["name"]: one["home"] for one in page.ask("api/world")["articulations"][0]["actuators"]}
    page.until(page.elbow_is(homes["elbow"]))


def test_curves_can_be_added_read_hidden_and_held(page: Page) -> None:
    curve = "document.querySelector('[data-sensor=\"arm/qpos/rad\"]')"
    page.driver.execute_script(
        "const add = document.querySelector('#add-curve'); add.value = 'arm/qpos/rad';"
        "add.dispatchEvent(new Event('change', {bubbles: true}))"
    )
    page.until(f"{curve} !== null")
    page.driver.execute_script(f"{curve}.scrollIntoView({{block: 'center'}})")
    page.until(f"/\\d/.test({curve}.querySelector('.signal .num').textContent)")
    assert page.look(f"{curve}.querySelector('.tag').textContent") == "rad"
    signal = page.look(f"{curve}.querySelector('.signal')")
    signal.click()
    assert signal.get_attribute("aria-pressed") == "false"
    page.click("#pause-curves")
    read = f"{curve}.querySelector('.signal:nth-child(3) .num').textContent"
    page.until(f"!document.querySelector('#scroll-back').hidden && {read} !== ''")
    held = page.look(read)
    page.slide(0.5)
    page.until(page.elbow_is(0.5))
    assert page.look(read) == held
    page.click("#pause-curves")
    page.until(f"{read} !== '{held}'")
    page.click('[data-sensor="arm/qpos/rad"] [title^=Remove]')
    page.until(f"{curve} === null")


def test_a_part_of_a_curve_is_enlarged_by_dragging_over_it(page: Page) -> None:
    page.until(RUNNING)
    canvas = page.look("document.querySelector('.curve canvas')")
    page.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    shown = "document.querySelector('#scroll-back').getAttribute('aria-valuetext')"
    page.choose("#span", "2")
    page.click("#pause-curves")
    from_s, to_s = (float(one) for one in re.findall(r"[\d.]+(?= s)", page.look(shown)))
    assert to_s - from_s == pytest.approx(2.0)
    half = canvas.size["width"] // 4
    ActionChains(page.driver).move_to_element_with_offset(canvas, -half, 0).click_and_hold().move_by_offset(
        half, 0
    ).release().perform()
    page.until(f"{shown} !== '{from_s:.2f} s to {to_s:.2f} s'")
    left, right = (float(one) for one in re.findall(r"[\d.]+(?= s)", page.look(shown)))
    assert from_s < left < right < to_s
    assert right - left == pytest.approx(0.5, abs=0.15)
    assert page.look("document.querySelector('#span').selectedOptions[0].text") == f"{right - left:.2f} s"
    ActionChains(page.driver).double_click(canvas).move_to_element(page.find("h1")).perform()
    page.until("document.querySelector('#scroll-back').hidden")
    assert page.look("document.querySelector('#span').value") == "2"
    page.choose("#span", "8")


def test_held_curves_outlive_a_reset(page: Page) -> None:
    page.until(RUNNING)
    for target in (0.0, 0.9):
        page.slide(target)
        page.until(page.elbow_is(target))
    page.driver.execute_script(
        "const add = document.querySelector('#add-curve'); add.value = 'arm/qpos/rad';"
        "add.dispatchEvent(new Event('change', {bubbles: true}))"
    )
    page.until("document.querySelector('[data-sensor=\"arm/qpos/rad\"]') !== null")
    page.click("#stop")
    page.until(f"!({RUNNING})")
    page.click("#pause-curves")
    held = page.curve("arm/qpos/rad", "elbow")
    assert max(held) > 0.5
    page.click("#reset")
    page.until("document.querySelector('#time').textContent === '0.00 s'")
    page.until(page.elbow_is(0.0))
    assert max(page.curve("arm/qpos/rad", "elbow")) == pytest.approx(max(held), abs=0.1)
    page.click("#pause-curves")
    page.click("#play")
    page.until(RUNNING)
    page.until("parseFloat(document.querySelector('#time').textContent) > 0.5")
    assert max(page.curve("arm/qpos/rad", "elbow")) < 0.5
    page.click('[data-sensor="arm/qpos/rad"] [title^=Remove]')


def test_a_curve_that_is_added_has_a_past(page: Page) -> None:
    page.until(RUNNING)
    for target in (0.0, 0.9):
        page.slide(target)
        page.until(page.elbow_is(target))
    page.click("#stop")
    page.until(f"!({RUNNING})")
    page.driver.execute_script(
        "const add = document.querySelector('#add-curve'); add.value = 'arm/qpos/rad';"
        "add.dispatchEvent(new Event('change', {bubbles: true}))"
    )
    page.until("document.querySelector('[data-sensor=\"arm/qpos/rad\"]') !== null")
    past = page.curve("arm/qpos/rad", "elbow")
    assert min(past) < 0.5 < max(past)
    page.click('[data-sensor="arm/qpos/rad"] [title^=Remove]')
    page.choose("#add-curve", "arm/follows/elbow")
    page.until("document.querySelector('[data-sensor=\"arm/follows/elbow\"]') !== null")
    wanted, position = (page.curve("arm/follows/elbow", name) for name in ("set-point", "position"))
    assert {0.0, 0.9} <= {*wanted}, "the set-point jumps"
    assert any(0.1 < value < 0.8 for value in position), "and the joint follows"
    page.click('[data-sensor="arm/follows/elbow"] [title^=Remove]')
    page.click("#play")
    page.until(RUNNING)


def test_what_a_page_has_skipped_or_was_before_it_is_in_its_curves(page: Page, tmp_path: Path) -> None:
    def moved(one: Page) -> bool:
        return any(0.1 < value < 0.8 for value in one.curve("arm/qpos/rad", "elbow", 8))

    page.until(RUNNING)
    page.choose("#add-curve", "arm/qpos/rad")
    page.slide(0.0)
    page.until(page.elbow_is(0.0))
    page.slide(0.9)
    page.driver.execute_async_script(  # as soon as the set-point is sent, the page is busy, until the arm is there
        "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => {"
        "const began = performance.now(); while (performance.now() < began + 2000); done(); }))"
    )
    page.until(page.elbow_is(0.9))
    page.click("#stop")
    page.until(f"!({RUNNING})")
    WebDriverWait(page.driver, PATIENCE_S).until(lambda _: moved(page), "the hole stays")
    with opened(tmp_path, page.invitation()) as second:
        second.until("document.querySelector('#add-curve')?.options.length > 1")
        second.choose("#add-curve", "arm/qpos/rad")
        second.until("document.querySelector('[data-sensor=\"arm/qpos/rad\"]') !== null")
        WebDriverWait(second.driver, PATIENCE_S).until(lambda _: moved(second), "a page begins without a past")
    page.click('[data-sensor="arm/qpos/rad"] [title^=Remove]')
    page.click("#play")
    page.until(RUNNING)


def test_the_scale_of_a_curve_is_fixed_and_released(page: Page) -> None:
    def axis(value: float) -> list[int]:
        page.slide(value)
        page.until(page.elbow_is(value))
        return page.driver.execute_async_script(
            "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => {"
            f"const canvas = {curve}.querySelector('canvas');"
            "done([...canvas.getContext('2d').getImageData(0, 0, 40, canvas.height).data]); }))"
        )

    curve = "document.querySelector('[data-sensor=\"arm/qpos/rad\"]')"
    page.until(RUNNING)
    page.choose("#span", "2")
    page.choose("#add-curve", "arm/qpos/rad")
    page.until(f"{curve} !== null")
    page.driver.execute_script(f"{curve}.scrollIntoView({{block: 'center'}})")
    page.until(f"/\\d/.test({curve}.querySelector('.signal .num').textContent)")
    axis(0.2)
    now = page.ask("api/state")["time"]
    page.asked("api/state", lambda state: state["time"] > now + 2.2)  # what came before is out of the picture
    fix = page.look(f"{curve}.querySelector('[aria-label^=\"Fix the y scale\"]')")
    fix.click()
    assert fix.get_attribute("aria-pressed") == "true"
    assert axis(0.2) == axis(0.9), "the scale stays, although the curve leaves it"
    fixed = axis(0.9)
    fix.click()
    assert fix.get_attribute("aria-pressed") == "false"
    WebDriverWait(page.driver, PATIENCE_S).until(lambda _: axis(0.9) != fixed)
    page.click('[data-sensor="arm/qpos/rad"] [title^=Remove]')
    page.choose("#span", "8")


def test_the_log_is_for_people_and_every_control_has_a_name_and_a_size(page: Page) -> None:
    shown = page.look("document.querySelector('#log').innerText")
    assert not re.search(r"session_id|tcp:|[{}]|\d\.\d{5}", shown), "ops, endpoints and digits are for programs"
    assert "The console is connected to the server." in shown
    assert page.look("document.querySelectorAll('h1').length") == 1
    unnamed = page.look(
        "[...document.querySelectorAll('button, input, select')].filter(one => !one.hidden && one.type !== 'file' && "
        "!(one.getAttribute('aria-label') || one.textContent.trim() || one.labels?.length)).map(one => one.outerHTML)"
    )
    assert unnamed == []
    small = page.look(
        "[...document.querySelectorAll('button, select, input[type=number]')].filter(one => one.offsetParent && "
        "(one.offsetHeight < 24 || one.offsetWidth < 24)).map(one => one.outerHTML)"
    )
    assert small == []


def test_the_controls_are_a_sheet_on_a_phone(page: Page) -> None:
    with page.phone():
        page.until("document.querySelector('#view .hint').textContent.includes('two fingers')")
        visible = "getComputedStyle(document.querySelector('#sheet')).visibility === 'visible'"
        page.until(f"!({visible})")
        page.driver.execute_script("window.scrollTo(0, 0)")
        page.click("#sheet-toggle")
        page.until(visible)
        assert page.look("document.querySelector('#sheet').contains(document.querySelector('#mode'))")
        page.until("getComputedStyle(document.querySelector('#sheet')).transform === 'none'")  # it slides
        picture, sheet = (
            page.look(f"document.querySelector('{one}').getBoundingClientRect().toJSON()")
            for one in (".instead canvas", "#sheet")
        )
        assert sheet["height"] < 0.45 * PHONE["height"]
        assert 0 <= picture["top"] < picture["bottom"] < sheet["top"], "what the controls move is seen above them"
        page.click("#sheet-toggle")
        page.until(f"!({visible})")
    page.until("document.querySelector('header').contains(document.querySelector('#mode'))")


def test_a_second_viewer_drives_only_when_the_first_lets_go(page: Page, tmp_path: Path) -> None:
    with opened(tmp_path, page.invitation()) as second:
        page.slide(0.2)  # only now: the controls are lost by not using them, and a browser may take long to start
        page.until("document.querySelector('#driver').dataset.who === 'me'")
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


def test_the_3d_view_follows_the_robot_shows_overlays_and_is_pushed(page: Page, tmp_path: Path) -> None:
    page.until("document.querySelector('#view').innerText.includes('no WebGL')")
    page.until("document.querySelector('#driver').dataset.who !== 'other'")  # who drove has closed their browser
    with opened(tmp_path, page.invitation(), (*SOLID, "--window-size=640,640")) as one:
        view = View(one)
        view.until_the_arm_is_seen()
        one.until("document.querySelector('#body').options.length > 3")
        one.click("#fit")
        if page.look("document.querySelector('#driver').dataset.who === 'me'"):
            page.click("#drive")
        one.until("document.querySelector('#driver').dataset.who === 'free'")
        one.slide(0.0)
        one.until(one.elbow_is(0.0))
        before = view.picture()
        one.slide(1.2)
        view.until_it_differs(before, "the arm never moved")
        shows_overlays(view)
        stays_where_it_is(view)
        is_pushed(view)


def stays_where_it_is(view: View) -> None:
    """What is said of a selected body does not move the view from under the pointer."""
    page = view.page
    small = page.driver.get_window_size()
    stage, card = (f"document.querySelector('{one}').getBoundingClientRect().top" for one in (".stage", "#view"))
    above = f"{stage} - {card}"
    for width in (1300, small["width"]):
        page.driver.set_window_size(width, small["height"])
        page.choose("#body", "-1")
        page.until("document.querySelector('#body-facts').textContent === ''")
        before = page.look(above)
        page.choose("#body", page.look("[...document.querySelector('#body').options].at(-1).value"))
        page.until("document.querySelector('#body-facts').textContent.includes('kg')")
        assert page.look(above) == before


def shows_overlays(view: View) -> None:
    view.page.click("#stop")
    view.page.until(f"!({RUNNING})")
    plain = view.picture()
    for overlay in ("#show-frames", "#show-contacts"):
        view.page.click(overlay)
        view.until_it_differs(plain, f"{overlay} showed nothing")
        view.page.click(overlay)
        view.until_it_is(plain, f"{overlay} stayed")


def is_pushed(view: View) -> None:
    page = view.page
    x, y, _ = view.select("quadruped")
    assert page.look("document.querySelector('#push').disabled"), "in mode live"
    assert "one physics step at most" in page.look("document.querySelector('#push').title")
    assert "one physics step at most" in page.look("document.querySelector('#view .hint').textContent")
    for _ in range(3):  # with Ctrl
        for kind in ("pointerdown", "pointermove", "pointerup"):
            view.pointer(kind, x, y, ctrlKey=True)
    page.until("document.querySelector('#toasts').textContent.includes('one physics step at most')")
    assert page.look("document.querySelectorAll('.toast').length") == 1
    page.choose("#mode", "direct")
    page.until("!document.querySelector('#step').disabled")
    if not page.look(RUNNING):
        page.click("#play")
    page.until(RUNNING)
    x, y, body = view.select("quadruped")
    height = page.ask(f"api/bodies/{body}")["position"][2]
    page.click("#push")
    view.pointer("pointerdown", x, y)
    view.pointer("pointermove", x, y - 60)
    page.asked(f"api/bodies/{body}", lambda one: one["position"][2] > height + 0.1)
    view.pointer("pointerup", x, y - 60)
    page.asked(f"api/bodies/{body}", lambda one: one["position"][2] < height + 0.05)
    page.choose("#mode", "live")
    page.until(RUNNING)


def test_a_killed_server_shows_as_such_and_comes_back(
    page: Page, console: tuple[dict[str, Any], str, contextlib.ExitStack]
) -> None:
    ready, _, stack = console
    page.until(RUNNING)
    place = f"document.querySelector('{SLIDER}').getBoundingClientRect().top"
    before = page.look(place)
    stack.close()  # kills it
    page.until("!document.querySelector('#banner').hidden && document.body.dataset.link === 'lost'")
    page.until("['#play', '#stop'].every((one) => document.querySelector(one).disabled)")
    page.until("document.querySelector('#log').innerText.includes('The server is unreachable. Retrying.')")
    page.until("document.body.classList.contains('stale')")
    page.until("document.querySelector('#announcements').textContent.includes('unreachable')")
    assert page.look(place) == before, "what the page says must not move a slider from under a finger"
    log = page.look("document.querySelector('#log').innerText")
    assert not re.search(r"tcp:|session_id|\d\.\d{5}", log)
    ports = [f"--{n}-port={ready[f'{n}_port']}" for n in ("step", "state", "ctrl", "info", "camera")]
    stack.enter_context(serve(*ports))
    page.until("document.body.dataset.link === 'connected' && document.querySelector('#banner').hidden")
    page.until("document.querySelector('#log').innerText.includes('this is a new session')")
    assert "Another program" not in page.look("document.querySelector('#log').innerText")
    assert page.look(place) == before
    page.until(RUNNING)
    page.slide(0.4)
    page.until(page.elbow_is(0.4))


def test_the_pointer_meets_in_the_3d_view_what_is_drawn_there(tmp_path: Path) -> None:
    def drawn(seen: np.ndarray) -> tuple[int, int]:
        """Return the rows of the arm in the middle column: it is white before a dark sky."""
        rows = np.flatnonzero(seen[:, seen.shape[1] // 2].min(axis=1) > 140)
        runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
        longest = max(runs, key=len)
        return (int(longest[0]), int(longest[-1])) if len(longest) else (0, 0)

    flags = (*SOLID, "--window-size=640,700")
    with (
        command("console", "sim://arm?play", "--port", "0") as (_, line),
        opened(tmp_path, link_in(line), flags) as one,
    ):
        one.until("document.querySelector('#body')?.length > 1")
        view = View(one)
        view.until_the_arm_is_seen()
        ray = f"{FRAME}.contentWindow.eval('(row) => viewerPointer.ray(innerWidth / 2, row)')"
        rows = range(0, view.picture().shape[0], 4)
        met = [row for row in rows if one.ask("api/pick", one.look(f"{ray}({row})"))["body"]]
        assert len(met) > 4
        ends = pytest.approx((met[0], met[-1]), abs=8)
        view.until_picture(lambda seen: drawn(seen) == ends, f"the arm is not drawn from row {met[0]} to {met[-1]}")
