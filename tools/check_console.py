"""How well the console keeps up: states and pictures a second as a viewer gets them, their age, what it costs.

    python tools/check_console.py [--seconds 10] [--viewers 1] [--browser | --view]

Three robots that are driven, two cameras watched, all on this machine: a simulated server, the console, and viewers
that say of each state and picture that they have it. With `--browser` one more viewer is a headless Chromium, which
draws everything but the 3-D view; its states count when they are drawn. With `--view` only that browser watches, and
draws the 3-D view, without a graphics card if there is none: what it loads, how long the first picture takes, and how
many follow. Prints figures only.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.support.ui import WebDriverWait
from websockets.asyncio.client import ClientConnection, connect

ROBOTS = "sim://arm?model=quadruped&model=arm&play&unpaused&camera-size=320x240"
CAMERAS = ("arm/overview", "quadruped/side")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--window-size=1300,900",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
FLAT = ("--disable-gpu", "--disable-3d-apis")
SOLID = ("--enable-unsafe-swiftshader",)


@contextmanager
def console() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `urlab console` with a server of its own and yield it with its link."""
    command = [sys.executable, "-m", "urlab_client", "console", ROBOTS, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - ours
        try:
            assert process.stdout is not None  # noqa: S101 - for the type checker
            yield process, next(word for word in process.stdout.readline().split() if word.startswith("http://"))
        finally:
            process.terminate()


def processor_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def child_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


class Watched:
    """What came to one viewer over one socket."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.ages_ms: list[float] = []
        self.received = 0

    def count(self, made_ms: float, size: int) -> None:
        self.ages_ms.append(time.time() * 1e3 - made_ms)
        self.received += size

    def line(self, seconds: float) -> str:
        if len(self.ages_ms) < 2:
            return f"{self.name:24} nothing"
        cuts = statistics.quantiles(self.ages_ms, n=100)
        return (
            f"{self.name:24} {len(self.ages_ms) / seconds:6.1f} Hz   age {cuts[49]:6.1f} ms (median) "
            f"{cuts[98]:6.1f} ms (99 %)   {self.received / seconds / 1024:7.0f} KiB/s"
        )


async def states(socket: ClientConnection, watched: Watched, *, drives: bool) -> None:
    swing = 0.0
    async for text in socket:
        message = json.loads(text)
        if message["type"] != "state":
            continue
        await socket.send('{"type": "ack"}')
        watched.count(message["made"], len(text))
        if drives and len(watched.ages_ms) % 6 == 0:
            swing = 0.5 - swing
            values = {key: {"elbow": swing} for key in message["articulations"] if key.startswith("arm")}
            await socket.send(json.dumps({"type": "ctrl", "values": values}))


async def pictures(socket: ClientConnection, watched: Watched) -> None:
    async for frame in socket:
        assert isinstance(frame, bytes)  # noqa: S101 - for the type checker
        await socket.send("shown")
        head = json.loads(frame[4 : 4 + int.from_bytes(frame[:4], "little")])
        watched.count(head["received"], len(frame))


async def watch(base: str, key: str, viewers: int, seconds: float) -> list[Watched]:
    found: list[Watched] = []
    headers = {"authorization": f"Bearer {key}"}
    async with asyncio.TaskGroup() as tasks:
        running: list[asyncio.Task[None]] = []
        for n in range(viewers):
            live = await connect(f"{base}/api/live", additional_headers=headers)
            found.append(Watched(f"viewer {n + 1}: states"))
            running.append(tasks.create_task(states(live, found[-1], drives=n == 0)))
            for camera in CAMERAS:
                socket = await connect(f"{base}/api/cameras/{camera}/live", additional_headers=headers)
                found.append(Watched(f"viewer {n + 1}: {camera}"))
                running.append(tasks.create_task(pictures(socket, found[-1])))
        await asyncio.sleep(2)  # until everything flows
        for one in found:
            one.ages_ms.clear()
            one.received = 0
        await asyncio.sleep(seconds)
        for task in running:
            task.cancel()
    return found


async def ready(base: str, key: str) -> None:
    async with connect(f"{base}/api/live", additional_headers={"authorization": f"Bearer {key}"}) as socket:
        async for text in socket:
            message = json.loads(text)
            if message["type"] == "world" and message["world"]["articulations"]:
                print(", ".join(art["key"] for art in message["world"]["articulations"]))
                return


def enter(link: str) -> str:
    """Spend the link's token for a key."""
    url = urlsplit(link)
    body = json.dumps({"token": url.query.removeprefix("token=")}).encode()
    request = urllib.request.Request(f"http://{url.netloc}/api/session", body, method="POST")
    with urllib.request.urlopen(request) as answer:  # noqa: S310
        return str(json.load(answer)["key"])


def invited(link: str, key: str) -> str:
    url = urlsplit(link)
    headers = {"authorization": f"Bearer {key}"}
    address = f"http://{url.netloc}/api/invitations"
    request = urllib.request.Request(address, b"{}", headers, method="POST")
    with urllib.request.urlopen(request) as answer:  # noqa: S310
        return f"http://{url.netloc}{json.load(answer)['path']}"


# What is counted in the page: states in the frame in which they are drawn, with their age then, and frames.
COUNT = """
window.counted = {ages: [], frames: 0};
import('./static/link.js').then(({on, clock}) => on('state', (state) => requestAnimationFrame(() =>
  window.counted.ages.push(Date.now() + clock.offset - state.made))));
const frame = () => { window.counted.frames += 1; requestAnimationFrame(frame); };
frame();
"""


# The same in the frame of the 3-D view.
COUNT_VIEW = """
const view = document.querySelector('#view iframe').contentWindow;
const draw = view.requestAnimationFrame;
window.viewed = 0;
view.requestAnimationFrame = (callback) => draw((now) => { window.viewed += 1; callback(now); });
"""
LOADED = """return [window, document.querySelector('#view iframe').contentWindow]
  .flatMap(({performance: one}) => [...one.getEntriesByType('navigation'), ...one.getEntriesByType('resource')])
  .reduce(([sent, whole], one) => [sent + one.transferSize, whole + one.decodedBodySize], [0, 0])"""


@contextmanager
def browser(link: str, *flags: str) -> Iterator[webdriver.Chrome]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = Options()
        options.binary_location = os.environ.get("CHROMIUM", "/usr/bin/chromium")
        for flag in (*FLAGS, *flags, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        driver = webdriver.Chrome(options, Service(os.environ.get("CHROMEDRIVER", "/usr/bin/chromedriver")))
        try:
            driver.set_script_timeout(240)  # without a graphics card a frame may take long
            driver.get(link)
            driver.execute_script(COUNT)
            yield driver
        finally:
            driver.quit()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--viewers", type=int, default=1)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--browser", action="store_true")
    what.add_argument("--view", action="store_true")
    arguments = parser.parse_args()
    seconds: float = arguments.seconds
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} before")
    with console() as (process, link):
        key = enter(link)
        base = f"ws://{urlsplit(link).netloc}"
        asyncio.run(ready(base, key))
        if arguments.view:
            look(invited(link, key), seconds)
        elif arguments.browser:
            with browser(invited(link, key), *FLAT) as driver:
                measure(process.pid, base, key, arguments.viewers, seconds)
                driver.execute_script("window.counted = {ages: [], frames: 0}")
                time.sleep(seconds)
                counted = driver.execute_script("return window.counted")
            drawn = Watched("browser alone: states")
            drawn.ages_ms = counted["ages"]
            print(f"{drawn.line(seconds)}, {counted['frames'] / seconds:.1f} frames/s")
        else:
            measure(process.pid, base, key, arguments.viewers, seconds)
    print(f"load {os.getloadavg()[0]:.1f} after")


def look(link: str, seconds: float) -> None:
    began = time.perf_counter()
    with browser(link, *SOLID) as driver:
        shown = "const cover = document.querySelector('#view .cover'); return Boolean(cover && cover.hidden)"
        WebDriverWait(driver, 240, 0.05).until(lambda _: driver.execute_script(shown))
        first = time.perf_counter() - began
        sent, whole = driver.execute_script(LOADED)
        driver.execute_script(COUNT_VIEW)
        counting = time.perf_counter()
        time.sleep(seconds)
        frames = driver.execute_script("return window.viewed") / (time.perf_counter() - counting)
    print(f"3-D view: first picture {first:.1f} s after the browser's start, then {frames:.1f} frames/s")
    print(f"loaded: {sent / 1e6:.1f} MB, {whole / 1e6:.1f} MB when unpacked")


def measure(pid: int, base: str, key: str, viewers: int, seconds: float) -> None:
    both = {"console": pid, "server": child_of(pid)}
    before, began = {name: processor_seconds(one) for name, one in both.items()}, time.perf_counter()
    for one in asyncio.run(watch(base, key, viewers, seconds)):
        print(one.line(seconds))
    took = time.perf_counter() - began
    for name, one in both.items():
        print(f"{name:24} {100 * (processor_seconds(one) - before[name]) / took:6.0f} % of one processor")


if __name__ == "__main__":
    main()
