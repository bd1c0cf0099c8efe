"""The requests of `docs/console-api.md`, made as written to the console that `docs/console.md` starts."""

from __future__ import annotations

import itertools
import json
import re
import shlex
from pathlib import Path
from urllib.request import Request, urlopen

from pages import ROOT, Block, blocks
from shell import Shell, same, steps
from waiting import eventually

DOCS = ROOT / "docs"


def block_with(page: str, text: str) -> Block:
    (block,) = [block for block in blocks(DOCS / page) if text in block.code]
    return block


def fetch(command: str, port: int, **variables: str) -> str:
    """Do what a `curl` command says."""
    for name, value in variables.items():
        command = command.replace(f"${name}", value)
    words = shlex.split(command)
    assert words[0] == "curl"
    options = dict(itertools.pairwise(words))
    (address,) = [word for word in words if word.startswith("localhost:8355/")]
    name, _, value = options.get("-H", "Accept: */*").partition(": ")
    url = "http://" + address.replace("8355", str(port), 1)
    with urlopen(Request(url, data=options["-d"].encode(), headers={name: value}), timeout=30) as reply:
        return reply.read().decode()


def knows_the_robots(port: int, key: str) -> bool:
    request = Request(f"http://localhost:{port}/api/world", headers={"Authorization": f"Bearer {key}"})
    with urlopen(request, timeout=30) as reply:
        return '"elbow"' in reply.read().decode()


def test_the_requests_work_as_shown(tmp_path: Path) -> None:
    commands = [command for command, _ in steps(block_with("console.md", "urlab console"))]
    (serve,) = [command for command in commands if command.startswith("urlab console 'sim:")]
    login, *others = steps(block_with("console-api.md", "curl"))
    shell = Shell(tmp_path)
    try:
        link = shell.run(serve)
        token = re.search(r"token=([\w-]+)", link)
        assert token is not None, link
        port = shell.ports["--port"]
        inner = re.fullmatch(r"KEY=\$\((curl .*) \| jq -r \.key\)", login[0])
        assert inner is not None, login[0]
        key = json.loads(fetch(inner[1].replace("…", token[1]), port))["key"]
        assert others
        eventually(lambda: knows_the_robots(port, key), "the console does not get to know its robots")
        for command, output in others:
            got = fetch(command, port, KEY=key)
            assert not output or not same(output, got), f"{command}: {got}"
        shell.close()
    finally:
        shell.abandon()
