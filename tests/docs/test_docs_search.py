"""The built site in a browser: its search puts answers before classes, and links to headings that moved lead there."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

import pytest
from console_page import FLAGS, FLAT, Page
from pages import ROOT
from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

ANSWERS = ("howto/", "quickstart", "install", "tutorials/")
HIT = "document.querySelector('.md-search-result__link')"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("site")
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        check=True,
        timeout=600,
    )
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            serving.join()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    options = Options()
    options.binary_location = "/usr/bin/chromium"
    home: Path = tmp_path_factory.mktemp("chromium")
    for flag in (*FLAGS, *FLAT, f"--user-data-dir={home}"):
        options.add_argument(flag)
    driver = webdriver.Chrome(options=options, service=Service("/usr/bin/chromedriver"))
    try:
        yield Page(driver)
    finally:
        driver.quit()


def first_hit(browser: Page, site: str, words: str) -> str:
    browser.driver.get(f"{site}/index.html?q={quote(words)}")
    browser.until(f"{HIT} !== null")
    address: str = browser.look(f"{HIT}.href")
    return address.removeprefix(f"{site}/").partition("?")[0]


@pytest.mark.parametrize(
    "words", ["joint position", "reset", "timeout", "save a video", "set joint angles", "how do I use the editor"]
)
def test_an_answer_comes_before_the_reference(browser: Page, site: str, words: str) -> None:
    assert first_hit(browser, site, words).startswith(ANSWERS)


@pytest.mark.parametrize("word", ["pandas", "docker", "headless", "jupyter", "urdf", "ros", "gpu", "ctrl-c", "replay"])
def test_common_words_lead_to_an_answer(browser: Page, site: str, word: str) -> None:
    assert first_hit(browser, site, word).startswith(ANSWERS)


@pytest.mark.parametrize(
    ("words", "page"),
    [("what happens when the server dies", "howto/index"), ("train with Stable-Baselines3", "howto/rl")],
)
def test_questions_lead_to_the_page_that_answers_them(browser: Page, site: str, words: str, page: str) -> None:
    assert first_hit(browser, site, words).startswith(page)


@pytest.mark.parametrize("name", ["set_ctrl", "state_stream"])
def test_names_of_the_api_lead_to_the_blocking_reference(browser: Page, site: str, name: str) -> None:
    assert first_hit(browser, site, name).startswith("reference/blocking")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("console.html#http", "console-api.html#http"),
        ("simulated-server.html#pictures", "simulated-server-pictures.html#pictures"),
        ("console.html#access", "console.html#access"),
    ],
)
def test_old_links_lead_to_where_a_heading_is(browser: Page, site: str, old: str, new: str) -> None:
    browser.driver.get(f"{site}/{old}")
    browser.until(f"location.href === '{site}/{new}'")
    browser.until(f"document.querySelector('h1{new[new.index('#') :]}, h2{new[new.index('#') :]}') !== null")
