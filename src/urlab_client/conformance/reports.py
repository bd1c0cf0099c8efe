"""What a run found, as a table, JSON, one HTML page, or a bundle to send, from which the user's names are left out."""

from __future__ import annotations

import getpass
import html
import json
import platform
import re
import socket
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, TypeAlias, cast

import msgspec

from urlab_client.conformance.declarations import StatementResult, Verdict
from urlab_client.conformance.runner import Report
from urlab_client.conformance.wire import Exchange, plain

Redact: TypeAlias = Callable[[str], str]

WORDS: Final = {Verdict.HOLDS: "holds", Verdict.DIFFERS: "differs", Verdict.NOT_TRIED: "not tried"}
_PRIVATE: Final = frozenset({"mjb", "mjb_base64", "mjcf_compiled", "vfs_assets", "data"})
"""Reply fields whose content stays here: models, their files, and pixels."""
_PATH: Final = re.compile(
    # C:\, \\SERVER, ipc://, or / unless a path of Unreal's follows.
    r"(?:(?<![A-Za-z])[A-Za-z]:[\\/](?!/)|\\\\(?=\w)|(?<=ipc:/)/|(?<=file:/)/"
    r"|(?<![\w/:])/(?!Game\b|Engine\b|Script\b))"
    # A blank is part of it if a separator follows in the next word.
    r"(?:[^\s\"'<>|*?]|[ ](?=[^\s\"'<>|*?:]*[\\/]))*"
)
_ADDRESS: Final = re.compile(r"(tcp://)(?!127\.0\.0\.1|0\.0\.0\.0|localhost|\[::1\])(?:\[[^\]\s]*\]|[^\s:/\"]+)")


def redaction(told: Mapping[str, str], *, allowed: bool) -> Redact:
    """Return what takes paths, host and user names, and the names of the scene out of a text.

    Args:
        told: Names that the server told, each with a word to replace it.
        allowed: Whether everything may stay.
    """
    if allowed:
        return lambda text: text
    own = {socket.gethostname(): "host", _user(): "user"}
    names = {name: word for name, word in {**told, **own}.items() if len(name) > 1 or name in told}
    known = sorted(names, key=len, reverse=True)
    pattern = re.compile("|".join(rf"(?<![A-Za-z0-9]){re.escape(name)}(?![A-Za-z0-9])" for name in known) or r"(?!)")

    def redact(text: str) -> str:
        text = _ADDRESS.sub(r"\1host", _PATH.sub("(path)", text))
        return pattern.sub(lambda found: names[found[0]], text)

    return redact


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # no entry for this user id
        return ""


def plain_report(report: Report, redact: Redact) -> dict[str, Any]:
    """Return a report as plain data, as `--json` writes it."""
    shown: dict[str, Any] = msgspec.to_builtins(report)
    for check in shown["checks"]:
        del check["group"], check["frames"]
    return {**_cleaned(shown, redact), "versions": versions()}


def versions() -> dict[str, str]:
    """Return the versions of what ran on this side."""
    import mujoco
    import zmq

    return {
        "urlab_client": version("urlab-client"),
        "python": platform.python_version(),
        "system": platform.system(),
        "mujoco": mujoco.mj_versionString(),
        "pyzmq": zmq.__version__,
    }


def _cleaned(value: Any, redact: Redact) -> Any:
    match value:
        case str():
            return redact(value)
        case dict():
            items = cast("dict[str, Any]", value).items()
            private = {key for key, item in items if key in _PRIVATE and isinstance(item, str)}
            return {
                redact(key): f"({len(item)} bytes)" if key in private else _cleaned(item, redact) for key, item in items
            }
        case list():
            return [_cleaned(item, redact) for item in cast("list[Any]", value)]
        case bytes():
            return f"({len(value)} bytes)"
        case _:
            return value


def counts(rows: Iterable[StatementResult]) -> str:
    """Return how many statements hold, differ and were not tried."""
    found = Counter(row.verdict for row in rows)
    said = {Verdict.HOLDS: ("holds", "hold"), Verdict.DIFFERS: ("differs", "differ")}
    counted = [f"{found[verdict]} {words[found[verdict] != 1]}" for verdict, words in said.items()]
    return ", ".join([*counted, f"{found[Verdict.NOT_TRIED]} not tried"])


def differences_first(report: Report) -> list[StatementResult]:
    """Return the statements with those that differ first, and those that were not tried last."""
    order = [Verdict.DIFFERS, Verdict.HOLDS, Verdict.NOT_TRIED]
    return sorted(report.statements, key=lambda row: order.index(row.verdict))


def readable(exchange: Exchange, redact: Redact) -> dict[str, Any]:
    """Return a recorded exchange as readable data."""
    both = {"request": exchange.request, "reply": exchange.reply}
    sizes = {"request": exchange.request_bytes, "reply": exchange.reply_bytes}
    return {
        "number": exchange.number,
        "op": exchange.op,
        "ms": round(1e3 * exchange.seconds, 3),
        **{name: _readable(frame, sizes[name], redact) for name, frame in both.items()},
    }


def _readable(frame: bytes, size: int, redact: Redact) -> Any:
    try:
        return _cleaned(plain(frame), redact)
    except ValueError:
        return f"({size} bytes)" if len(frame) < size else f"(not a message: {frame[:32].hex()})"


def page(report: Report, exchanges: Iterable[Exchange], redact: Redact) -> str:
    """Return a report as one HTML page that needs nothing else, with the differences and their frames first."""
    kept = {str(exchange.number): exchange for exchange in exchanges}
    return "".join(_page(report, kept, redact))


_STYLE: Final = """body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;
color:#1b1f24}
table{border-collapse:collapse;width:100%}td,th{text-align:left;vertical-align:top;padding:.35rem .6rem;
border-bottom:1px solid #d8dde3}.differs{background:#fdecea}.not_tried{color:#6a737d}code,pre{font:13px/1.45 monospace}
pre{background:#f5f6f8;padding:.6rem;overflow:auto;white-space:pre-wrap}td:first-child,td:nth-child(3){white-space:nowrap}
@media(prefers-color-scheme:dark){body{background:#14171a;color:#e4e7ea}.differs{background:#43201d}pre{background:#20252a}
td,th{border-color:#353b42}.not_tried{color:#98a1ab}}"""


def _page(report: Report, kept: dict[str, Exchange], redact: Redact) -> Iterator[str]:
    server = {name: value for name, value in report.server.items() if value not in (None, "", [])}
    server["capabilities"] = ", ".join(report.server["capabilities"]) or "none told"
    yield "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
    yield f"<title>URLab conformance</title><style>{_STYLE}</style><h1>URLab conformance</h1>"
    yield f"<p><strong>{counts(report.statements)}</strong></p>"
    for note in (report.stopped, *(f"Not put back: {line}" for line in report.left)):
        if note:
            yield f"<p class=differs>{html.escape(redact(note))}</p>"
    yield "<table>"
    for name, value in (server | {f"here: {name}": text for name, text in versions().items()}).items():
        yield f"<tr><th>{html.escape(name)}<td>{html.escape(redact(str(value)))}"
    yield "</table><h2>Statements</h2><table><tr><th>Statement<th>What it says<th>Verdict<th>What was checked"
    for row in differences_first(report):
        detail = html.escape(redact(row.detail))
        frames = [readable(kept[number], redact) for number in row.frames if number in kept]
        if frames:
            shown = "\n".join(json.dumps(frame, indent=1, ensure_ascii=False, default=str) for frame in frames)
            detail += f"<details><summary>{len(frames)} exchanges</summary><pre>{html.escape(shown)}</pre></details>"
        yield f"<tr class={row.verdict}><td>{html.escape(row.id)}<td>{_code(row.title)}"
        yield f"<td>{WORDS[row.verdict]}<td>{detail}"
    measured = json.dumps(_cleaned(report.measurements, redact), indent=1, default=str)
    yield f"</table><h2>Measurements</h2><p>Measured, not judged.</p><pre>{html.escape(measured)}</pre></html>"


def _code(text: str) -> str:
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text, quote=False))


def write_bundle(path: Path, report: Report, exchanges: Iterable[Exchange], redact: Redact, *, raw: bool) -> None:
    """Write report and exchanges to a ZIP file that can be attached to an issue.

    Args:
        path: The file.
        report: The report.
        exchanges: The exchanges.
        redact: Takes names out.
        raw: Whether the frames are added as they were, with every name in them.
    """
    kept = list(exchanges)
    lines = (json.dumps(readable(exchange, redact), ensure_ascii=False, default=str) for exchange in kept)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bundle:
        bundle.writestr("report.json", json.dumps(plain_report(report, redact), indent=1, default=str))
        bundle.writestr("report.html", page(report, kept, redact))
        bundle.writestr("exchanges.jsonl", "\n".join(lines) + "\n")
        for exchange in kept if raw else ():
            for name, frame in (("request", exchange.request), ("reply", exchange.reply)):
                bundle.writestr(f"frames/{exchange.number:05}-{exchange.op}.{name}", frame)
