"""Whether a server keeps to the wire: checks of it, each declared with the statements that it proves.

`urlab conformance` and the tests in `tests/conformance` run the same checks. What a check finds is a verdict on each of
its statements: it holds, it differs (with what was expected, what came and the recorded frames), or it was not tried.
"""

from __future__ import annotations

from urlab_client.conformance.bench import Bench
from urlab_client.conformance.declarations import (
    CHECKS,
    Check,
    Differs,
    Group,
    NotTried,
    StatementResult,
    Verdict,
    statement_titles,
)
from urlab_client.conformance.runner import CheckResult, Choice, Report, one, run
from urlab_client.conformance.wire import Wire

__all__ = [
    "CHECKS",
    "Bench",
    "Check",
    "CheckResult",
    "Choice",
    "Differs",
    "Group",
    "NotTried",
    "Report",
    "StatementResult",
    "Verdict",
    "Wire",
    "one",
    "run",
    "statement_titles",
]
