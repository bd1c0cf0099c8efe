"""`urlab conformance`: find out whether a server keeps to the wire.

Check a server against the statements about the wire that this project rests on, and say of each whether it holds,
differs (with what was expected and what came), or was not tried. Without options it only reads, but it opens a session,
which takes the server over from the client that drives it. --play drives the robots of a play session, and begins one
if none runs. --author makes a level of its own, and opens yours again: save yours first. Exits with 0 if nothing
differs, with 1 if something does, and with 2 if the server cannot be checked. Ctrl-C puts back what was changed, and
reports what was found until then.
"""

from __future__ import annotations

import asyncio
import shutil
import sys
import tempfile
import textwrap
from argparse import Namespace
from typing import Final
from urllib.parse import urlencode

from urlab_client.aio.launch import SCHEME
from urlab_client.aio.transport.connection import client_keys
from urlab_client.cli._arguments import CLIENT, address_usage
from urlab_client.cli._common import (
    CommandError,
    aligned,
    check_ending,
    import_mujoco,
    json_line,
    progress_bar,
    refusing,
    sigterm_interrupts,
)
from urlab_client.conformance.bench import Bench, write_robot
from urlab_client.conformance.declarations import Differs, Group, Verdict, statement_titles
from urlab_client.conformance.reports import (
    WORDS,
    counts,
    differences_first,
    page,
    plain_report,
    redaction,
    write_bundle,
)
from urlab_client.conformance.runner import Choice, Report
from urlab_client.conformance.runner import run as run_checks
from urlab_client.conformance.wire import Wire
from urlab_client.values.names import did_you_mean

USAGE = f"""
{address_usage()}
--play  also drive the robots of a play session
--author  also edit, in a level that is removed afterwards
--only WORD...  checks with this word in their title
--statement NAME...  checks that prove this statement, such as 'Beta 12'; a number alone is one of the beta's
--no-measurements  do not measure times and rates
--transport zmq|shm=zmq  way of the requests
--import MJCF  with --author: model on the server's machine to import (default: a small robot in a temporary folder)
--timeout SECONDS=10  how long to wait for each reply
--trust-server  load the binary model of a server on another machine that has no key; it is trusted with one
report:
--all  also print the statements that were not tried
--json FILE  write the report as JSON; - for standard output
--html FILE  write the report as one page
--bundle FILE  write report, versions and exchanges to a ZIP file
--with-names  keep paths, host, user and robot names in these files, and add the raw frames to the bundle
{CLIENT}
examples:
urlab conformance  read from the editor on this machine; changes nothing
urlab conformance --play --author --bundle report.zip  everything; keep a file to attach to an issue
urlab conformance sim://arm --play --html report.html  the same on a simulated server, as one page
"""
_FAILED: Final = 2
_WHAT: Final = "what was checked"


def run(arguments: Namespace) -> int:
    """Check a server and print what was found."""
    choice = _choice(arguments)
    for path, ending in ((arguments.html, ".html"), (arguments.bundle, ".zip")):
        if path is not None:
            check_ending(path, ending)
    import_mujoco()
    with sigterm_interrupts():
        bench, report = asyncio.run(_check(arguments, choice))
    _write(arguments, bench, report)
    if report.differing:
        return 1
    if report.stopped or any(row.verdict is Verdict.HOLDS for row in report.statements):
        return _FAILED if report.stopped else 0
    raise CommandError("nothing was tried: no check that was chosen could run on this server; --all says why")


def _choice(arguments: Namespace) -> Choice:
    titles = statement_titles()
    names = [f"Beta {name}" if name.isdigit() else name for name in arguments.statement]
    for name in names:
        if name not in titles:
            raise CommandError(f"--statement: {name!r} is not a statement.{did_you_mean(name, titles)}")
    groups = {Group.READ, *([Group.PLAY] if arguments.play else []), *([Group.AUTHOR] if arguments.author else [])}
    return Choice(frozenset(groups), tuple(arguments.only), tuple(names), not arguments.no_measurements)


async def _check(arguments: Namespace, choice: Choice) -> tuple[Bench, Report]:
    own = arguments.address.startswith(SCHEME)
    with tempfile.TemporaryDirectory(prefix="urlab-") as folder:
        if not own:
            return await _checked(arguments, choice, arguments.address)
        # What the checks import lies in a folder that the server may read.
        options = {"model-root": folder, **({"mjcf-options": ""} if arguments.mjcf_options else {})}
        if "shm" not in arguments.address:
            options["shm-dir"] = folder
        separator = "&" if "?" in arguments.address else "?"
        address = f"{arguments.address}{separator}{urlencode(options)}"
        return await _checked(arguments, choice, address, write_robot(folder))


async def _checked(
    arguments: Namespace, choice: Choice, address: str, own_robot: str | None = None
) -> tuple[Bench, Report]:
    with refusing(ValueError):
        keys = client_keys(address, arguments.server_key, arguments.client_key)
        shm = arguments.transport == "shm"
        wire = Wire(address, arguments.step_port, keys, shm=shm, timeout=arguments.timeout)
    trusted = True if arguments.trust_server or keys is not None else None
    file = getattr(arguments, "import") or own_robot
    bench = Bench(wire, own_server=own_robot is not None, trusted=trusted, import_file=file)
    partial: list[Report] = []
    try:
        try:
            await bench.open()
        except Differs as error:
            raise CommandError(f"{arguments.address} cannot be checked: {error}") from error
        bench.state_port = arguments.state_port or wire.transport.state_port or bench.state_port
        with progress_bar("checking", 1.0) as show:
            return bench, await run_checks(
                bench, choice, lambda _, done, whole: show(done / max(whole, 1)), partial.append
            )
    except asyncio.CancelledError:
        for report in partial:
            _write(arguments, bench, report)
        raise
    finally:
        await asyncio.shield(wire.aclose())


def _write(arguments: Namespace, bench: Bench, report: Report) -> None:
    redact = redaction(bench.names, allowed=arguments.with_names)
    exchanges = tuple(bench.wire.exchanges)
    if arguments.html is not None:
        arguments.html.write_text(page(report, exchanges, redact), encoding="utf-8")
    if arguments.bundle is not None:
        write_bundle(arguments.bundle, report, exchanges, redact, raw=arguments.with_names)
    if arguments.json is not None:
        text = json_line(plain_report(report, redact))
        if str(arguments.json) == "-":
            print(text)
            return
        arguments.json.write_text(text + "\n", encoding="utf-8")
    _print(arguments, report)


def _folded(table: str) -> str:
    """Return a table whose last column is folded at a terminal."""
    if not sys.stdout.isatty():
        return table
    columns, below = shutil.get_terminal_size().columns, " " * table.index(_WHAT)
    return "\n".join(textwrap.fill(line, columns, subsequent_indent=below) for line in table.splitlines())


def _print(arguments: Namespace, report: Report) -> None:
    shown = [row for row in differences_first(report) if row.verdict is not Verdict.NOT_TRIED or arguments.all]
    rows = [(row.id, WORDS[row.verdict], row.detail) for row in shown]
    print(_folded(aligned([("statement", "verdict", _WHAT), *rows])))
    server = report.server
    generation = f", generation {server['generation']}" if server["generation"] else ""
    print(f"{server['address']}: {server['urlab_version']}{generation}, MuJoCo {server['mujoco_version']}")
    print(f"{counts(report.statements)}, by {len(report.checks)} checks and {server['requests']} requests.")
    if not arguments.all:
        print("--all also prints what was not tried, and what that needs.")
    for line in report.left:
        sys.stderr.write(f"urlab conformance: not put back: {line}\n")
    if report.stopped:
        sys.stderr.write(f"urlab conformance: {report.stopped}; what came after was not tried\n")
