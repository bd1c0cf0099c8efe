"""The console as a service: behind a real nginx with TLS and a path, with keys, probes, logs and signals."""

from __future__ import annotations

import asyncio
import configparser
import contextlib
import hmac
import json
import os
import re
import shlex
import shutil
import signal
import ssl
import subprocess
import sys
from collections.abc import AsyncGenerator, Generator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from children import child
from ports import free_port
from starlette.responses import Response
from starlette.testclient import TestClient
from waiting import DEADLINE_S, attempts
from websockets.asyncio.client import connect

from urlab_client.cli import _parser
from urlab_client.web.access import Access, Guarded

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "production.md").read_text(encoding="utf-8")
NGINX = shutil.which("nginx", path=f"{os.environ['PATH']}{os.pathsep}/usr/sbin")
KEY = "a key that is long enough".replace(" ", "-")
MAIN = """
{user}
daemon off;
pid {folder}/nginx.pid;
error_log stderr;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    {site}
}}
"""


def block(language: str) -> str:
    """Return the page's code block in a language."""
    found = re.search(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


@contextlib.contextmanager
def console(folder: Path, *options: str) -> Generator[tuple[Any, str]]:
    """Run `urlab console`, and yield its process and the link that it prints."""
    command = ("-m", "urlab_client", "console", "sim://arm?play&unpaused", "--json-log", *options)
    with child(*command, cwd=folder, env={**os.environ, "URLAB_CONSOLE_KEY": KEY}) as process:
        printed = process.stdout.readline()
        found = re.search(r"https?://\S+", printed)
        assert found is not None, printed + process.communicate()[1]
        yield process, found[0]


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """A certificate of localhost, with its key, under the names that the page has."""
    made = tmp_path / "fullchain.pem"
    command = (
        "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=localhost -days 1 -addext subjectAltName=DNS:localhost"
    )
    subprocess.run(
        [*command.split(), "-keyout", tmp_path / "privkey.pem", "-out", made], check=True, capture_output=True
    )
    return made


@contextlib.contextmanager
def nginx(folder: Path, site: str) -> Generator[None]:
    """Run nginx with a site while the block runs."""
    user = "user root;" if os.geteuid() == 0 else ""  # which lets it write into the test's folder
    (folder / "nginx.conf").write_text(MAIN.format(user=user, folder=folder, site=site), encoding="utf-8")
    command = [str(NGINX), "-e", "stderr", "-p", folder, "-c", folder / "nginx.conf"]
    with subprocess.Popen(command) as process:
        try:
            yield
        finally:
            process.terminate()


@contextlib.asynccontextmanager
async def watched(url: str, cookie: str, http: httpx2.AsyncClient, **options: Any) -> AsyncGenerator[None]:
    """Watch the console as a browser does, by WebSocket and by event stream, while the block runs."""
    headers = {"cookie": cookie} if cookie else {"authorization": f"Bearer {KEY}"}
    socket_url = f"{url.replace('http', 'ws', 1)}/api/live"
    async with (
        connect(socket_url, additional_headers=headers, max_size=None, close_timeout=0.1, **options) as socket,
        http.stream("GET", f"{url}/api/events", headers=headers) as events,
    ):
        assert json.loads(await socket.recv())["type"] == "you"
        lines = events.aiter_lines()
        assert (await anext(lines)).startswith("event: ")
        yield


async def test_programs_have_a_key_and_sigterm_ends_it_while_browsers_watch(tmp_path: Path) -> None:
    with console(tmp_path, "--port", "0") as (process, link):
        url = link.partition("/?")[0]
        async with httpx2.AsyncClient(base_url=url, timeout=DEADLINE_S) as http:
            assert (await http.get("/healthz", headers={"host": "10.1.2.3"})).status_code == 200
            refused = await http.get("/metrics")
            assert (refused.status_code, refused.headers["www-authenticate"]) == (401, 'Bearer realm="URLab"')
            assert (await http.get("/.well-known/oauth-protected-resource")).status_code == 404
            key = {"authorization": f"Bearer {KEY}"}
            assert "urlab" in (await http.get("/metrics", headers=key)).text
            assert (await http.get("/api/status", headers=key)).status_code == 200
            async with watched(url, "", http):
                process.send_signal(signal.SIGTERM)
                output, log = await asyncio.to_thread(process.communicate, timeout=DEADLINE_S)
    assert (process.returncode, output) == (0, "")
    lines = [json.loads(line) for line in log.splitlines()]
    # It would log an error if the time passed that requests have after SIGTERM before they are given up.
    assert {"at", "level", "logger", "message"} <= set(lines[0])
    assert [line for line in lines if "error" in line or line["level"] == "error"] == []
    assert "Application shutdown complete." in [line["message"] for line in lines]


@pytest.mark.skipif(NGINX is None, reason="needs nginx: apt install nginx-light")
async def test_behind_nginx_with_tls_and_a_path(tmp_path: Path, certificate: Path) -> None:
    inner, outer = free_port(), free_port()
    site = block("nginx").replace("listen 443 ssl", f"listen 127.0.0.1:{outer} ssl").replace("8355", str(inner))
    site = site.replace("/etc/letsencrypt/live/lab.example", str(tmp_path))
    trusted = ssl.create_default_context(cafile=str(certificate))
    url = f"https://localhost:{outer}/robots"
    with (
        console(tmp_path, "--port", str(inner), "--public-url", f"{url}/") as (_, link),
        nginx(tmp_path, site),
    ):
        assert link.startswith(f"{url}/?token=")
        async with httpx2.AsyncClient(verify=trusted, follow_redirects=True, timeout=DEADLINE_S) as http:
            for _ in attempts("nginx does not serve"):
                with contextlib.suppress(httpx2.ConnectError):
                    assert (await http.get(f"{url}/healthz")).status_code == 200
                    break
            entered = await http.get(link)
            assert (entered.status_code, str(entered.url)) == (200, f"{url}/")
            cookie = entered.history[0].headers["set-cookie"]
            assert "path=/robots/" in cookie.lower()
            assert "secure" in cookie.lower()
            for part in re.findall(r'(?:src|href)="([^"]+)"', entered.text):
                assert (await http.get(f"{url}/{part}")).status_code == 200, part
            document = (await http.get(f"{url}/api/openapi.json")).json()
            assert document["servers"] == [{"url": "/robots"}]
            sockets = (await http.get(f"{url}/api/asyncapi.json")).json()["servers"]["console"]
            assert (sockets["host"], sockets["protocol"]) == (f"localhost:{outer}", "wss")
            origin = f"https://localhost:{outer}"
            assert (await http.post(f"{url}/api/lease", headers={"origin": origin})).status_code == 200
            async with watched(url, cookie.partition(";")[0], http, ssl=trusted, origin=origin):
                pass


def test_enter_in_the_terminal_prints_another_link_for_one_browser() -> None:
    from terminal import Terminal  # needs a pseudoterminal

    program = """
        import sys
        os.dup2(os.open("/dev/tty", os.O_RDWR), 0)
        from urlab_client.cli import main
        sys.exit(main(["console", "sim://ball", "--port", "0"]))
    """
    with Terminal(program) as terminal:
        first = terminal.line()
        assert "Enter prints another link" in first
        terminal.type("\n")
        second = terminal.line()
        links = [re.findall(r"http://\S+token=\S+", line) for line in (first, second)]
        assert len({link for found in links for link in found}) == 2
        assert httpx2.get(links[1][0]).status_code == 303
        assert httpx2.get(links[1][0]).status_code == 401
        terminal.press_ctrl_c()
        assert terminal.end()[0] == 0


def test_without_any_input_there_is_no_such_offer() -> None:
    arguments = [sys.executable, "-m", "urlab_client", "console", "sim://ball", "--port", "0"]
    with subprocess.Popen(["sh", "-c", 'exec "$@" <&-', "sh", *arguments], stdout=subprocess.PIPE, text=True) as one:
        assert one.stdout is not None
        said = one.stdout.readline()
        one.send_signal(signal.SIGTERM)
        assert one.wait(DEADLINE_S) == 0
    assert "token=" in said
    assert "Enter" not in said


def test_a_used_link_is_refused_with_the_advice_of_its_application() -> None:
    guarded = Guarded(Response("inside"), Access(), advice="Ask Ann for a link.")
    answer = TestClient(guarded, base_url="http://localhost").get("/?token=used")
    assert answer.status_code == 401
    assert answer.json()["error"]["message"].endswith("restarted. Ask Ann for a link.")


def test_an_invitation_may_be_added_while_a_token_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    access = Access()
    token, compared = access.invite(), hmac.compare_digest

    def compare(known: bytes, given: bytes) -> bool:
        access.invite()
        return compared(known, given)

    monkeypatch.setattr(hmac, "compare_digest", compare)
    assert access.admit("another") is None
    assert access.admit(token) is not None


def test_service_and_container_run_commands_that_exist() -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read_string(block("ini"))
    program, *options = shlex.split(unit["Service"]["ExecStart"])
    assert program.endswith("/urlab")
    assert _parser("console").parse_args(options).public_url == "https://lab.example/robots"

    steps = [line.split(None, 1) for line in block("dockerfile").splitlines()]
    assert {step for step, _ in steps} <= {"FROM", "COPY", "RUN", "USER", "WORKDIR", "EXPOSE", "ENTRYPOINT"}
    assert steps[0][0] == "FROM"
    program, *options = json.loads(dict(steps)["ENTRYPOINT"])
    told = re.search(r"IMAGE\s+(tcp.*?)`", PAGE.replace("\n", " "))
    assert told is not None
    arguments = _parser("console").parse_args([*options, *told[1].split()])
    assert (program, arguments.host, arguments.address) == ("urlab", "0.0.0.0", "tcp://10.0.0.7")


def test_a_terminal_is_told_when_it_gets_no_more_links() -> None:
    from terminal import Terminal

    program = """
        import logging, threading
        os.dup2(os.open("/dev/tty", os.O_RDWR), 0)
        from urlab_client.cli import main
        from urlab_client.web import Access
        invite = Access.invite
        def invite_first(access):
            if threading.current_thread().name == "urlab-console-links":
                raise MemoryError("none left")
            return invite(access)
        Access.invite = invite_first
        logging.getLogger("urlab_client.web").addHandler(logging.StreamHandler(sys.stdout))
        sys.exit(main(["console", "sim://ball", "--port", "0"]))
    """
    with Terminal(program) as terminal:
        terminal.line()
        terminal.type("\n")
        assert terminal.line() == "no more links: MemoryError('none left')"
        terminal.press_ctrl_c()
        assert terminal.end()[0] == 0
