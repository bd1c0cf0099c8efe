"""Status and body of HTTP error responses and refusals."""

from __future__ import annotations

from typing import Any

from urlab_client.console.lease import NotDriving
from urlab_client.errors import (
    OutcomeUnknown,
    URLabConnectionError,
    URLabError,
    URLabRPCError,
    URLabTimeoutError,
)


def explain_error(error: Exception) -> tuple[int, dict[str, Any]]:
    """Return the HTTP status and the description of an error."""
    hint = (getattr(error, "hint", None) or "") if isinstance(error, URLabError) else ""
    text = error.args[0] if isinstance(error, URLabError) and error.args else str(error)
    match error:
        case NotDriving():
            status, code = 423, "not_driving"
        case URLabRPCError():
            status, code = 409, error.code
            text = error.message
        case URLabTimeoutError():
            status, code = 504, "timeout"
        case OutcomeUnknown():
            status, code = 502, "outcome_unknown"
        case URLabConnectionError():
            status, code = 503, "unreachable"
        case URLabError():
            status, code = 502, "failed"
        case OSError():
            status, code = 500, "io_failed"
        case _:
            status, code = 400, "bad_request"
    return status, {"code": code, "message": str(text), "hint": hint}
