"""Access to the console: one-time tokens, and checks of a request's host and origin."""

from __future__ import annotations

import hmac
import html
import secrets
from collections.abc import Collection
from http.cookies import CookieError, SimpleCookie
from typing import TypeAlias
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Names of this machine for itself."""

HEALTH = "/healthz"
"""Path that needs neither a key nor a host name."""

_MOST = 1000  # unused invitations and keys of closed browsers would accumulate
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
_HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'; "
    "base-uri 'none'; form-action 'self'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",  # the 3-D view's threads need an isolated page
    "cross-origin-embedder-policy": "require-corp",
    "cache-control": "no-store",
}
_PAGE = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>URLab console</title><body><h1>{title}</h1><p>{text}</p></body></html>"""

_ADVICE = (
    "Open the link that `urlab console` printed; it works for one browser. Enter in that terminal prints another link, "
    "and Invite on an open page makes one."
)

_Refusal: TypeAlias = tuple[int, str, str]


class Access:
    """Rules for access to the application.

    The first browser or program that presents a token exchanges it for a key: a cookie, or the reply to
    `POST /api/session`, for use as `Authorization: Bearer KEY`. The newest thousand tokens and the thousand most
    recently used keys are valid.

    Args:
        hosts: Host names by which the application is reached, in lower case. Others are refused, so that a page
            elsewhere cannot reach it by its own name (DNS rebinding).
        tokens: Whether a key is required. False is for applications that authenticate users themselves.
        keys: Keys that are valid without a token.
    """

    def __init__(self, *, hosts: Collection[str] = LOOPBACK, tokens: bool = True, keys: Collection[str] = ()) -> None:
        self.hosts: frozenset[str] = frozenset(hosts)
        self.tokens = tokens
        self.cookie: str = f"urlab_{secrets.token_hex(4)}"  # cookies of a host go to all its ports
        self._tokens: dict[str, None] = {}
        self._given = frozenset(keys)
        self._keys: dict[str, None] = {}

    def invite(self) -> str:
        """Return a new token, valid for one use."""
        token = secrets.token_urlsafe(24)
        _keep(self._tokens, token)
        return token

    def admit(self, token: str) -> str | None:
        """Exchange a token for a key; return None if the token is unknown or has been used."""
        found = _among(token, self._tokens)
        if found is None:
            return None
        del self._tokens[found]
        key = secrets.token_urlsafe(32)
        _keep(self._keys, key)
        return key

    def key_of(self, headers: Headers) -> str | None:
        """Return the valid key that came with a request, or None."""
        scheme, _, value = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self._known(value.strip())
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self.cookie)
        except CookieError:
            return None
        return None if cookie is None else self._known(cookie.value)

    def _known(self, value: str) -> str | None:
        if (given := _among(value, self._given)) is not None:
            return given
        found = _among(value, self._keys)
        if found is not None:
            _keep(self._keys, found)
        return found

    def refusal(self, scope: Scope) -> _Refusal | None:
        """Return status, code and reason if a request is refused regardless of its key, otherwise None."""
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if _name(host) not in self.hosts:
            return (
                403,
                "bad_host",
                f"This console does not serve the host {host!r}, only {', '.join(sorted(self.hosts))}.",
            )
        origin = headers.get("origin")
        changes = scope["type"] == "websocket" or scope["method"] not in _SAFE
        if origin is not None and changes and urlsplit(origin).netloc.lower() != host.lower():
            return 403, "bad_origin", f"A page of {origin!r} may not use this console."
        return None


class Guarded:
    """Middleware that passes only the requests that `Access` allows.

    Args:
        app: The application.
        access: The access rules.
        advice: Message for requests without a key.
    """

    def __init__(self, app: ASGIApp, access: Access, *, advice: str = _ADVICE) -> None:
        self._app = app
        self._access = access
        self._advice = advice

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a request, or pass it to the application."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        path = _path(scope)
        refused = None if path == HEALTH else self._access.refusal(scope)  # probes reach it by an address
        if refused is None and self._access.tokens:
            admitted = self._exchange_token(scope)
            if admitted is not None:
                await admitted(scope, receive, _with_headers(send))
                return
            key = self._access.key_of(Headers(scope=scope))
            scope["urlab_key"] = key
            # Where there is no document, programs must hear so: a 401 makes them look for an authorization server.
            if key is None and not _is_login(scope) and path != HEALTH and not path.startswith("/.well-known/"):
                refused = 401, "no_key", self._advice
        if refused is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await _close(receive, send)
        else:
            await _denied(scope, refused)(scope, receive, _with_headers(send))

    def _exchange_token(self, scope: Scope) -> Response | None:
        """Return the response to a browser that presents a token, or None for any other request."""
        if scope["type"] != "http" or scope["method"] != "GET" or _path(scope) not in {"", "/"}:
            return None
        token = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token")
        if token is None:
            return None
        key = self._access.admit(token[0])
        if key is None and self._access.key_of(Headers(scope=scope)) is None:
            return _denied(
                scope, (401, "bad_token", f"This link has been used, or the console restarted. {self._advice}")
            )
        response = RedirectResponse(f"{scope.get('root_path', '')}/", status_code=303)
        if key is not None:
            response.set_cookie(
                self._access.cookie,
                key,
                path=f"{scope.get('root_path', '')}/",
                httponly=True,
                samesite="strict",
                secure=scope["scheme"] == "https",
            )
        return response


def _keep(values: dict[str, None], value: str) -> None:
    """Add a value as the newest, or make it the newest, and drop the oldest if there are too many."""
    values.pop(value, None)
    values[value] = None
    if len(values) > _MOST:
        del values[next(iter(values))]


def _among(value: str, values: Collection[str]) -> str | None:
    given = value.encode()
    # A copy, as another thread may add an invitation meanwhile.
    return next((known for known in tuple(values) if hmac.compare_digest(known.encode(), given)), None)


def _name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _path(scope: Scope) -> str:
    return str(scope["path"]).removeprefix(scope.get("root_path", ""))


def _is_login(scope: Scope) -> bool:
    return scope["type"] == "http" and scope["method"] == "POST" and _path(scope) == "/api/session"


def _denied(scope: Scope, refusal: _Refusal) -> Response:
    status, code, text = refusal
    headers = {"www-authenticate": 'Bearer realm="URLab"'} if status == 401 else None
    if "text/html" in Headers(scope=scope).get("accept", ""):
        return HTMLResponse(_PAGE.format(title="Access denied", text=html.escape(text)), status, headers)
    return JSONResponse({"error": {"code": code, "message": text, "hint": ""}}, status, headers)


async def _close(receive: Receive, send: Send) -> None:
    await receive()
    await send({"type": "websocket.close", "code": 4403, "reason": "refused"})


def _with_headers(send: Send) -> Send:
    async def guarded(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return guarded
