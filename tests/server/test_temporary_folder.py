"""Temporary folders: a killed process leaves none for long."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from urlab_client.server.system.temporary_folder import TemporaryFolder


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def elsewhere() -> tuple[subprocess.Popen[str], Path]:
    """Make a folder in another process, which then waits."""
    script = (
        "from urlab_client.server.system.temporary_folder import TemporaryFolder; f = TemporaryFolder(); "
        "print(f.path, flush=True); input()"
    )
    process = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_a_folder_goes_with_its_owner(temporary: Path) -> None:
    with TemporaryFolder() as scratch:
        (scratch.path / "level.json").write_text("{}")
        assert scratch.path.parent == temporary
        assert sys.platform == "win32" or scratch.path.stat().st_mode & 0o077 == 0
    scratch.close()
    assert not list(temporary.iterdir())


def test_the_next_one_removes_what_a_killed_process_left_and_nothing_else(temporary: Path) -> None:
    process, left = elsewhere()
    foreign = temporary / "urlab-notes"
    foreign.mkdir()
    with TemporaryFolder():
        assert left.is_dir(), "its owner lives"
    process.kill()
    process.communicate()
    with TemporaryFolder() as scratch:
        assert set(temporary.iterdir()) == {scratch.path, foreign}


def test_a_forked_child_removes_nothing() -> None:
    with TemporaryFolder() as scratch:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # other tests may have left a thread
            pid = os.fork()
        if pid == 0:
            scratch.close()
            os._exit(0)
        os.waitpid(pid, 0)
        assert scratch.path.is_dir()
