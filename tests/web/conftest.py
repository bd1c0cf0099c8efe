"""Each refusal that any test of the console meets is one that a person or a program can use."""

from __future__ import annotations

import sys
from typing import Any

import pytest


@pytest.fixture(autouse=True)
def _refusals_explain_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    testing: Any = sys.modules.get("starlette.testclient")  # not there where the extra is not installed
    if testing is None:
        return
    send = testing.TestClient.send

    def checked(self: Any, *args: Any, **kwargs: Any) -> Any:
        answer = send(self, *args, **kwargs)
        if answer.status_code >= 400 and answer.headers.get("content-type", "").startswith("application/json"):
            error = answer.json().get("error", {})
            assert isinstance(error.get("code"), str), answer.text
            assert error["code"].isidentifier(), answer.text
            assert isinstance(error.get("message"), str), answer.text
            assert error["message"], answer.text
            assert isinstance(error.get("hint"), str), answer.text
            assert error["hint"] == "" or " " in error["hint"], answer.text
        return answer

    monkeypatch.setattr(testing.TestClient, "send", checked)
