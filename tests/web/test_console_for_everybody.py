"""The console's page for people who are new to it, who use no mouse, or who do not see it, in a real Chromium."""

from __future__ import annotations

import contextlib
import json
import sys
import time
import urllib.request
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from console_page import RUNNING, SLIDER, Page, command, link_in, opened
from ports import free_port
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

AXE = Path(sys.prefix, "axe", "axe_playwright_python", "axe.min.js")
"""The rules of axe-core, as .ci/run installs them."""

FIND = """const done = arguments[0]; axe.run({resultTypes: ["violations"]}).then(({violations}) => done(
  violations.flatMap((one) => one.nodes.map((node) => `${one.help}: ${node.html} (${node.failureSummary})`))))"""
UNFOLD = """const closed = [...document.querySelectorAll('main details:not([open])')];
  closed.forEach((one) => { one.open = true; }); return closed"""
FOLD = "arguments[0].forEach((one) => { one.open = false; })"
FAR = """const fetched = window.fetch; window.fetch = async (...asked) => { const answer = await fetched(...asked);
  await new Promise((resolve) => setTimeout(resolve, 1000)); return answer; };
  window.near = () => { window.fetch = fetched; }"""
"""Let each answer take a second longer, as from a console far away."""
PANELS = "[...document.querySelectorAll('.column')].map((one) => [...one.children].map(({id}) => id))"
SPOKEN = "document.querySelector('#announcements').textContent"
TOP = f"document.querySelector('{SLIDER}').getBoundingClientRect().top"
MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ROCK = """<mujoco><asset><mesh name="rock" file="meshes/rock.obj"/></asset><worldbody><body name="rock">
<freejoint/><geom type="mesh" mesh="rock" mass="1"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page before a quadruped with torque motors and an arm, which stand still."""
    with first_page(tmp_path_factory.mktemp("page"), tmp_path_factory.mktemp("recordings")) as one:
        yield one


@contextlib.contextmanager
def first_page(profile: Path, folder: Path) -> Iterator[Page]:
    """Open a page before robots that nobody has driven yet."""
    ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    with contextlib.ExitStack() as stack:
        robots = ("quadruped", "arm", "--play", "--camera-size", "64x48")
        _, line = stack.enter_context(command("serve", *robots, "--json", *ports))
        ready = json.loads(line)
        ours = [f"--step-port={ready['step_port']}", f"--state-port={ready['state_port']}", "--port=0"]
        _, said = stack.enter_context(command("console", ready["address"], *ours, f"--recordings={folder}"))
        one = stack.enter_context(opened(profile, link_in(said)))
        one.until(
            f"document.querySelector('{SLIDER}') !== null && document.querySelector('#time').textContent.includes('s')"
        )
        yield one


@pytest.fixture
def still(page: Page) -> Iterator[Page]:
    """The page with physics stopped, the robots as at first, and the panels where they were."""
    page.ask("api/run", {"running": False})
    page.until(f"!({RUNNING})")
    page.ask("api/hold", {"quadruped": False})
    page.ask("api/ops/reset", {})
    yield page
    page.driver.execute_script("document.querySelectorAll('dialog[open]').forEach((one) => one.close())")


@contextlib.contextmanager
def unfolded(page: Page) -> Iterator[None]:
    """Open what is closed, and close that again: the page remembers whether its 3-D view was open."""
    closed = page.driver.execute_script(UNFOLD)
    try:
        yield
    finally:
        page.driver.execute_script(FOLD, closed)


def tab_to(page: Page, name: str) -> None:
    """Press Tab until the control of this name has the focus, and see that it shows."""
    page.driver.execute_script("document.activeElement.blur()")
    for _ in range(200):
        ActionChains(page.driver).send_keys(Keys.TAB).perform()
        found = page.look(
            "[document.activeElement.getAttribute('aria-label') || document.activeElement.textContent.trim(),"
            "getComputedStyle(document.activeElement).outlineStyle]"
        )
        if found[0] == name:
            assert found[1] == "solid"
            return
    raise AssertionError(f"Tab does not lead to {name!r}")


@pytest.mark.opengl
def test_a_simulation_that_stands_still_shows_pictures_also_instead_of_the_3d_view(still: Page) -> None:
    still.until("document.querySelector('#age').textContent === 'paused'")
    pixels = "canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data"
    drawn = f"(canvas => canvas && {pixels}.some((value, i) => i % 4 === 1 && value > 90))"
    still.driver.execute_script("document.querySelector('.instead .camera').scrollIntoView({block: 'center'})")
    still.until(f"{drawn}(document.querySelector('.instead canvas'))")
    chosen = still.look("document.querySelector('.instead .camera').dataset.camera")
    options = still.look("[...document.querySelector('#camera-instead').options].map(({value}) => value)")
    other = next(one for one in options if one != chosen)
    still.choose("#camera-instead", other)
    still.until(f"document.querySelector('.instead .camera').dataset.camera === '{other}'")
    still.until(f"{drawn}(document.querySelector('.instead canvas'))")
    assert not still.look("document.querySelector('.instead .num').classList.contains('old')")
    for shown in (True, False):
        still.find(".instead .frame").click()
        still.until(f"(document.fullscreenElement?.matches('.instead .camera') ?? false) === {str(shown).lower()}")


def test_a_robot_that_has_fallen_is_stood_up_and_held(still: Page) -> None:
    button, said = (f".robot[data-robot=quadruped] .still {part}" for part in ("button", "span"))
    still.ask("api/run", {"running": True})
    still.until(f"document.querySelector('{said}').textContent.startsWith('It has fallen.')")
    assert still.look(f"document.querySelector('{button}').textContent") == "Reset and hold"
    still.driver.execute_script(FAR)
    still.click(button)
    still.until(f"document.querySelector('{said}').textContent.startsWith('It holds its home pose until')")
    still.driver.execute_script("window.near()")
    still.asked("api/state", lambda state: state["time"] > 3.0)
    assert still.ask("api/state")["articulations"]["quadruped"]["qpos"][2] > 0.25
    still.click(button)  # lets it go
    still.until(f"document.querySelector('{said}').textContent.startsWith('It has fallen.')")
    still.ask("api/run", {"running": False})
    still.ask("api/ops/reset", {})
    still.ask("api/hold", {"quadruped": True})
    still.until(f"document.querySelector('{said}').textContent.startsWith('It holds its home pose')")
    still.click(button)  # while no step takes its torques away
    still.until(
        f"document.querySelector('{said}').textContent === 'Nothing drives it yet. Play makes it hold its pose.'"
    )
    still.ask("api/ops/set_mode", {"mode": "puppet"})
    still.until(f"document.querySelector('{said}').textContent.startsWith('In mode puppet')")
    still.until("[...document.querySelectorAll('.actuators')].every(one => one.inert)")
    still.ask("api/ops/set_mode", {"mode": "live"})


def test_a_page_says_nothing_of_states_that_have_come(still: Page) -> None:
    """The console has been connected for longer than a first state may take, and no other status follows."""
    still.asked("api/status", lambda status: time.time() - status["link"]["since"] > 6.0)
    still.driver.refresh()
    still.until("document.querySelector('#time').textContent.includes('s')")
    assert still.look("document.querySelector('#banner').hidden")
    assert "No state arrives" not in still.look(SPOKEN)


def test_the_log_counts_only_what_is_the_same(still: Page) -> None:
    lines = "[...document.querySelectorAll('.entries .call')].map((one) => one.innerText)"
    for running in (True, False):
        still.ask("api/run", {"running": running})
    for percent in (50.0, 60.0):
        still.ask("api/ops/set_sim_speed", {"percent": percent})
    still.until(f"/set the speed to 60 %\\s+.2$/.test(({lines}).at(-1).trim())")
    said = still.look(f"({lines}).slice(-3)")
    assert "let physics run" in said[0]
    assert "paused physics" in said[1] or "stopped physics" in said[1]
    still.ask("api/ops/set_sim_speed", {"percent": 100.0})


def test_a_panel_folds_and_stays_so(still: Page) -> None:
    scene = "document.querySelector('#scene')"
    title = f"{scene}.querySelector('h2 > .fold')"
    assert still.look(f"{scene}.querySelector('.actors').offsetHeight > 0")
    still.look(f"{title}.click()")
    assert still.look(f"[{title}.ariaExpanded, {scene}.querySelector('.actors').offsetHeight]") == ["false", 0]
    still.driver.refresh()
    still.until(f"{scene}.querySelector('[data-actor]') !== null")
    assert still.look(f"[{title}.ariaExpanded, {scene}.querySelector('.actors').offsetHeight]") == ["false", 0]
    still.look(f"{title}.click()")
    assert still.look(f"{title}.ariaExpanded === 'true' && {scene}.querySelector('.actors').offsetHeight > 0")


def test_a_number_out_of_reach_is_not_set_silently(still: Page) -> None:
    box = still.find("[data-robot=arm] [data-set-point=elbow]")
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("99", Keys.ENTER)
    still.until("document.querySelector('#toasts').innerText.includes('99 is out of reach')")
    still.until("document.querySelector('#log').innerText.includes('set elbow of arm')")


def test_an_edit_of_the_level_is_marked_until_play_begins_again(still: Page) -> None:
    due = "!document.querySelector('#edits-due').hidden && document.querySelector('#restart').matches('.due')"
    assert not still.look(due)
    box = still.find("[data-actor=arm] input")
    before = box.get_attribute("value")
    for value in ("0.7", before):
        box.send_keys(Keys.CONTROL, "a")
        box.send_keys(value, Keys.ENTER)
        still.until(due)
        still.until("document.querySelector('#log').innerText.includes('moved arm')")
    still.ask("api/ops/stop_pie", {})
    still.ask("api/ops/begin_pie", {})
    still.until(f"!({due})")


def test_a_page_that_gets_no_states_says_why(tmp_path: Path) -> None:
    ports = [f"--{name}-port=0" for name in ("step", "state", "ctrl", "info", "camera")]
    with contextlib.ExitStack() as stack:
        _, line = stack.enter_context(command("serve", "ball", "--play", "--json", *ports))
        ready = json.loads(line)
        wrong = [f"--step-port={ready['step_port']}", f"--state-port={free_port()}", "--port=0"]
        _, said = stack.enter_context(command("console", ready["address"], *wrong))
        one = stack.enter_context(opened(tmp_path, link_in(said)))
        one.until("document.querySelector('#banner').textContent.startsWith('No state arrives.')")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("small", [False, True], ids=["desk", "phone"])
def test_axe_finds_nothing(still: Page, scheme: str, small: bool) -> None:
    if not AXE.exists():
        pytest.skip(f"needs axe-core: pip install --no-deps --target {AXE.parents[1]} axe-playwright-python")
    driver = still.driver
    driver.execute_cdp_cmd(
        "Emulation.setEmulatedMedia", {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    )
    driver.execute_script(AXE.read_text("utf-8"))
    with contextlib.ExitStack() as stack:
        if small:
            stack.enter_context(still.phone())
            still.until("getComputedStyle(document.querySelector('#sheet')).opacity === '0'")  # it fades
            assert driver.execute_async_script(FIND) == []
            still.click("#sheet-toggle")
            still.until("getComputedStyle(document.querySelector('#sheet')).opacity === '1'")
            stack.callback(still.click, "#sheet-toggle")
        assert driver.execute_async_script(FIND) == []
        stack.enter_context(unfolded(still))
        assert driver.execute_async_script(FIND) == []
        for opens, dialog in (
            ("[aria-label=Keys]", "help"),
            ("#invite", "invitation"),
            (".robot .why", "findings"),
        ):
            still.click(opens)
            still.until(f"document.querySelector('#{dialog}').open")
            assert driver.execute_async_script(FIND) == []
            driver.execute_script(f"document.querySelector('#{dialog}').close()")


def test_a_screen_reader_has_a_name_for_every_control_and_hears_whether_it_is_pressed(still: Page) -> None:
    still.driver.execute_cdp_cmd("Accessibility.enable", {})
    with unfolded(still):
        nodes = still.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    roles = {"button", "slider", "spinbutton", "combobox", "checkbox", "textbox", "image", "region", "application"}
    controls = [one for one in nodes if not one["ignored"] and one["role"]["value"] in roles]
    assert len(controls) > 100
    assert [one for one in controls if not one["name"]["value"]] == []
    names = {one["name"]["value"] for one in controls}
    assert {"▶ Play", "■ Stop", "elbow set-point, rad", "Picture of quadruped / side", "Twist: W A S D"} <= names
    pressed = {
        one["name"]["value"]: next((p["value"]["value"] for p in one["properties"] if p["name"] == "pressed"), None)
        for one in controls
        if one["role"]["value"] == "button"
    }
    assert pressed["Hold pose"] == "false"
    legend = [value for name, value in pressed.items() if name[0] in "xyz" and not name[1:2].isalpha()]
    assert legend
    assert all(value == "true" for value in legend), pressed


def test_everything_is_done_by_keys_alone(still: Page) -> None:
    def press(*keys: str) -> None:
        ActionChains(still.driver).send_keys(*keys).perform()

    tab_to(still, "▶ Play")
    press(Keys.ENTER)
    still.until(RUNNING)
    tab_to(still, "elbow set-point, rad")
    value = still.look(f"+document.querySelector('{SLIDER}').value")
    press(*[Keys.ARROW_RIGHT] * 30)
    still.until(f"+document.querySelector('{SLIDER}').value > {value} + 0.05")
    tab_to(still, "Enlarge quadruped / side")
    press(Keys.ENTER)
    large = "document.querySelector('[data-camera=\"quadruped/side\"].large')"
    still.until(f"{large} !== null")
    press(Keys.ENTER)
    still.until(f"{large} === null")
    press(Keys.ESCAPE)
    still.until(f"!({RUNNING})")


def test_the_first_tab_stop_skips_to_the_controls(still: Page) -> None:
    still.driver.refresh()
    still.until(f"document.querySelector('{SLIDER}') !== null")
    ActionChains(still.driver).send_keys(Keys.TAB).perform()
    link = still.driver.switch_to.active_element
    assert link.text == "Skip to controls"
    assert link.rect["x"] >= 0
    ActionChains(still.driver).send_keys(Keys.ENTER).perform()
    still.until("document.activeElement.id === 'robots'")
    header, robots = (
        still.look(f"document.querySelector('{one}').getBoundingClientRect()") for one in ("header", ".robot")
    )
    assert robots["top"] >= header["bottom"]
    assert link.rect["x"] < 0
    for _ in range(2):  # the grip, and the title, of the first robot
        ActionChains(still.driver).send_keys(Keys.TAB).perform()
    assert still.look("document.activeElement.closest('.robot') !== null")


def test_escape_makes_a_picture_small_and_stops_nothing_then(still: Page) -> None:
    def escape() -> None:
        ActionChains(still.driver).send_keys(Keys.ESCAPE).perform()

    still.click("#play")
    still.until(RUNNING)
    camera = "#cameras [data-camera='arm/overview']"
    still.driver.execute_script(f'document.querySelector("{camera}").scrollIntoView({{block: "center"}})')
    still.find(f"{camera} .frame").click()
    large = f'document.querySelector("{camera}").matches(".large")'
    still.until(large)
    still.find(f"{camera} [title='Full screen']").click()
    still.until("document.fullscreenElement?.dataset.camera === 'arm/overview'")
    picture = still.look("document.fullscreenElement.querySelector('canvas').getBoundingClientRect()")
    assert picture["height"] > 0.8 * still.look("innerHeight")
    assert picture["bottom"] < still.look("innerHeight"), "its buttons are below it"
    escape()
    still.until("document.fullscreenElement === null")
    assert still.look(large)
    escape()
    still.until(f"!{large}")
    still.asked("api/status", lambda status: status["running"])
    escape()
    still.until(f"!({RUNNING})")


def test_in_puppet_mode_joints_go_where_a_number_says_within_their_limits(still: Page) -> None:
    def at(value: float) -> None:
        joints = {one["name"]: one["index"] for one in still.ask("api/world")["articulations"][1]["joints"]}
        still.asked(
            "api/state", lambda state: abs(state["articulations"]["arm"]["qpos"][joints["elbow"]] - value) < 1e-3
        )

    still.choose("#mode", "puppet")
    box = still.find("[data-robot=arm] [data-placed=elbow]")
    still.until("document.querySelector('[data-robot=arm] [data-placed=elbow]').offsetParent !== null")
    assert box.get_attribute("title") == "\u22121.4 … 2.62 rad"
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("0.7", Keys.ENTER)
    at(0.7)
    box.send_keys(Keys.CONTROL, "a")
    box.send_keys("99", Keys.ENTER)
    still.until("document.querySelector('#toasts').innerText.includes('99 is out of reach')")
    at(2.61799)
    assert still.look("+document.querySelector('[data-robot=arm] [data-place=elbow]').value") == pytest.approx(
        2.618, abs=1e-3
    )
    still.choose("#mode", "live")


def test_panels_are_moved_by_keys_and_by_the_mouse_and_stay_there(still: Page) -> None:
    first = still.look(PANELS)
    tab_to(still, "Move Log")
    ActionChains(still.driver).send_keys(Keys.ARROW_RIGHT, Keys.ARROW_UP).perform()
    assert "log" not in still.look(PANELS)[0]
    place = still.look(PANELS)[1].index("log")
    assert place < len(first[1])
    assert still.look(SPOKEN).startswith("Log: place ")
    assert still.look("document.activeElement.getAttribute('aria-label')") == "Move Log"
    still.driver.execute_script("window.scrollTo(0, 0)")
    grip, title = still.find("#cameras > .grip"), still.find(".robot h2")
    ActionChains(still.driver).click_and_hold(grip).move_to_element(title).perform()
    assert still.look("document.querySelector('.column .drop') !== null"), "where it would go is shown"
    ActionChains(still.driver).release().perform()
    moved = still.look(PANELS)
    assert moved[1][0] == "cameras"
    still.driver.refresh()
    still.until(f"document.querySelector('{SLIDER}') !== null")
    assert still.look(PANELS) == moved
    still.click("[aria-label=Keys]")
    still.click("#reset-layout")
    assert still.look(PANELS) == first
    still.driver.refresh()
    still.until(f"document.querySelector('{SLIDER}') !== null")
    assert still.look(PANELS) == first


def test_play_keeps_a_mode_that_somebody_has_chosen(still: Page) -> None:
    said, button = (f"document.querySelector('[data-robot=quadruped] .still {part}')" for part in ("span", "button"))
    for mode in ("direct", "live"):
        still.choose("#mode", mode)
        still.asked("api/status", lambda status, mode=mode: status["mode"] == mode and status["mode_chosen"])
    still.until(f"{said}.textContent.startsWith('Nothing drives it, so it falls in mode live. “Hold pose” chooses')")
    still.click("#play")
    still.until(f"{said}.textContent.startsWith('It has fallen.')")
    assert still.look("document.querySelector('#mode').value") == "live"
    still.click("#stop")
    still.until(f"!({RUNNING})")
    still.ask("api/ops/reset", {})
    still.until(f"{button}.textContent === 'Hold pose'")
    still.look(f"{button}.click()")
    still.until("document.querySelector('#toasts').textContent.includes('The mode is now direct, not live')")
    still.until("document.querySelector('#mode').value === 'direct'")


def test_why_it_does_not_move_names_first_what_keeps_all_from_moving(still: Page) -> None:
    def findings() -> list[str]:
        still.click("[data-robot=quadruped] .why")
        still.until("document.querySelector('#findings').open")
        found: list[str] = still.look("[...document.querySelectorAll('#findings li')].map((one) => one.textContent)")
        still.driver.execute_script("document.querySelector('#findings').close()")
        return found

    still.ask("api/ops/set_mode", {"mode": "live"})
    still.ask("api/ops/set_paused", {"paused": True})
    still.until("document.querySelector('#mode').value === 'live'")
    still.until("document.querySelector('#age').textContent === 'paused'")
    assert findings()[0].startswith("Physics Physics stands still")
    still.ask("api/hold", {"quadruped": True})
    still.until("document.querySelector('[data-robot=quadruped] .still').textContent.startsWith('It holds')")
    assert findings() == [
        "Physics Nothing steps it now. Press Play.",
        "quadruped It holds its home pose as soon as physics runs.",
    ]
    still.ask("api/hold", {"quadruped": False})
    still.ask("api/ops/set_mode", {"mode": "live"})


def test_the_same_message_shows_once(still: Page) -> None:
    still.driver.execute_async_script(
        "const done = arguments[0]; import('/static/dom.js').then(({toast}) => {"
        "document.querySelector('#toasts').replaceChildren();"
        "for (const one of ['a', 'b', 'a', 'a']) toast(one); done(); })"
    )
    assert still.look("[...document.querySelectorAll('.toast')].map((one) => one.textContent)") == ["b", "a"]


def test_what_has_the_focus_is_not_behind_the_bar(still: Page) -> None:
    behind: list[str] = []

    def back(edge: str) -> None:
        still.driver.execute_script(
            "window.scrollTo(0, document.body.scrollHeight); document.querySelector('#contacts summary').focus()"
        )
        for _ in range(60):
            ActionChains(still.driver).key_down(Keys.SHIFT).send_keys(Keys.TAB).key_up(Keys.SHIFT).perform()
            behind.extend(
                still.look(
                    "((one) => one.closest('main') && !one.matches('.grip') && "
                    f"one.getBoundingClientRect().top < {edge} ? [one.outerHTML] : [])(document.activeElement)"
                )
            )

    back("document.querySelector('#bar').getBoundingClientRect().bottom")
    assert behind == []
    with still.phone():
        still.driver.execute_script("window.scrollTo(0, 0); document.querySelector('#view summary').focus()")
        edge = "document.querySelector('.controls').getBoundingClientRect().top"
        for _ in range(30):
            ActionChains(still.driver).send_keys(Keys.TAB).perform()
            behind.extend(
                still.look(
                    "((one) => one.closest('.wide') && "
                    f"one.getBoundingClientRect().bottom > {edge} ? [one.outerHTML] : [])(document.activeElement)"
                )
            )
    assert behind == []


def test_the_first_play_leaves_a_robot_with_torque_motors_standing(tmp_path: Path) -> None:
    with first_page(tmp_path / "page", tmp_path / "recordings") as page:
        stays_standing(page)


def stays_standing(still: Page) -> None:
    def height(state: Any) -> float:
        return float(state["articulations"]["quadruped"]["qpos"][2])

    still.until(
        "document.querySelector('[data-robot=quadruped] .still')?.textContent.includes('and chooses mode direct')"
    )
    before = still.look(TOP)
    still.click("#play")
    still.until("document.querySelector('#toasts').textContent.includes('The mode is now direct, not live')")
    still.asked("api/state", lambda state: state["time"] > 0.7)
    assert height(still.ask("api/state")) > 0.25
    hold = "document.querySelector('[data-robot=quadruped] .still button').getAttribute('aria-pressed')"
    still.until(f"{hold} === 'true'")
    still.driver.execute_script(
        "const one = document.querySelector('[data-robot=quadruped] [data-actuator=FL_hip]'); one.value = 3;"
        "one.dispatchEvent(new Event('input', {bubbles: true}))"
    )
    still.until(f"{hold} === 'false'")
    assert still.look(TOP) == before, "what the page says of a robot must not move a slider from under a finger"
    still.ask("api/ops/reset", {})
    still.click("[data-robot=quadruped] .still button")
    still.until(f"{hold} === 'true'")
    still.click("[data-robot=quadruped] .still button")
    still.until(f"{hold} === 'false'")
    still.asked("api/state", lambda state: height(state) < 0.2)


def test_an_invitation_shows_its_link_which_admits_one_browser(still: Page) -> None:
    still.click("#invite")
    still.until("document.querySelector('#invitation').open")
    link = still.look("document.querySelector('#invitation input').value")
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with opener.open(link) as answer:
        assert "URLab console" in answer.read().decode()
    with pytest.raises(urllib.request.HTTPError, match="401") as refused:
        urllib.request.urlopen(urllib.request.Request(link, headers={"accept": "text/html"}))
    said = refused.value.read().decode()
    assert "has been used" in said
    assert "Enter" in said


def test_a_model_with_meshes_is_imported_and_spawned(still: Page, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "rock.zip", "w") as archive:
        archive.writestr("rock.xml", ROCK)
        archive.writestr("meshes/rock.obj", MESH)
    still.find("#model-file").send_keys(str(tmp_path / "rock.zip"))
    still.until("document.querySelector('#blueprint').selectedOptions[0]?.text === 'rock'")
    still.click("#spawn")
    still.until("document.querySelector('[data-actor=rock]') !== null")
    still.driver.execute_script("for (let i = 0; i < 2; i++) document.querySelector('#restart').click()")
    still.until("document.querySelector('[data-robot=rock]') !== null")
    bodies = still.ask("api/bodies")["bodies"]
    assert any(one["robot"] == "rock" for one in bodies)
    log = still.look("document.querySelector('#log').innerText")
    assert "imported rock" in log
    assert "added rock" in log
