"""What the documentation promises stands there still, and tests of these names hold it."""

from __future__ import annotations

import pytest

import gen_promises


def test_every_promise_is_made_and_held(capsys: pytest.CaptureFixture[str]) -> None:
    assert gen_promises.main(["--check"]) == 0, capsys.readouterr()
