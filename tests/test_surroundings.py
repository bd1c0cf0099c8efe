"""The tests pass wherever they run, and leave no process behind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from children import DEADLINE_S, in_background
from waiting import eventually

TESTS = Path(__file__).parent

INNER = """
import signal, subprocess, sys
import pytest

HANGS = "import os, subprocess, sys, time; {0} print(os.getpid(), flush=True); time.sleep(600)"
STARTS = "subprocess.Popen([sys.executable, '-c', sys.argv[1]]);"

def test_interrupts_itself():
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)

def test_fails_with_a_child_and_its_child():
    command = [sys.executable, "-c", HANGS.format(STARTS), HANGS.format("")]
    child = subprocess.Popen(command, stdout=subprocess.PIPE)
    started = [int(child.stdout.readline()) for _ in range(2)]
    with open("started", "w") as file:
        print(*started, file=file)
    raise AssertionError

@pytest.mark.mujoco("99.0")
def test_needs_a_later_release():
    raise AssertionError

@pytest.mark.parametrize("camera", [1, 2])
@pytest.mark.opengl
def test_draws(camera):
    raise AssertionError

@pytest.fixture
def picture(opengl):
    raise AssertionError

def test_looks(picture):
    raise AssertionError
"""

LEFT_OUT = [
    "1 left out, which need MuJoCo 99.0 or later; this is",
    "test_inner.py: test_needs_a_later_release",
    "3 left out, which need OpenGL: MUJOCO_GL=off disables OpenGL; unset it",
    "test_inner.py: test_draws, test_looks",
]

WITH_PICTURES = ["server/test_rendering.py", "server/test_snapshot.py", "conformance/test_capture.py"]


def test_in_the_background_without_opengl(tmp_path: Path) -> None:
    """Interrupts reach tests, a failed one leaves no process, and those that cannot run are named with the reason."""
    (tmp_path / "test_inner.py").write_text(INNER, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    environment = {**os.environ, "MUJOCO_GL": "off"}
    environment.pop("URLAB_TESTS_WITHOUT_OPENGL", None)
    path = [str(TESTS), str(TESTS / "support"), os.environ.get("PYTHONPATH", "")]
    with in_background():
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", "-n", "1", "-p", "conftest", "-p", "no:cacheprovider"],
            cwd=tmp_path,
            env={**environment, "PYTHONPATH": os.pathsep.join(path)},
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
    assert "1 failed, 1 passed" in done.stdout, done.stdout + done.stderr
    said = [
        line for line in done.stdout.splitlines() if "left out, which" in line or line.startswith("test_inner.py: ")
    ]
    assert [line[: len(expected)] for line, expected in zip(said, LEFT_OUT, strict=True)] == LEFT_OUT
    started = (tmp_path / "started").read_text(encoding="utf-8").split()
    assert len(started) == 2
    for process in started:
        eventually(lambda process=process: not Path(f"/proc/{process}/exe").exists(), "a child is left")


def test_where_pictures_are_the_subject_the_rest_passes_without_opengl() -> None:
    """Exactly what draws is left out: nothing fails, and nothing waits for a picture."""
    environment = {**os.environ, "MUJOCO_GL": "off"}
    environment.pop("URLAB_TESTS_WITHOUT_OPENGL", None)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *WITH_PICTURES],
        cwd=TESTS,
        env=environment,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "left out, which need OpenGL: MUJOCO_GL=off disables OpenGL; unset it" in done.stdout
    assert "server/test_rendering.py: test_a_bare_name_means_the_last_robot, " in done.stdout
