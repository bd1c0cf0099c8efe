"""Run the core of the test suite with other versions of what the package stands on.

Run: python tools/check_versions.py [ENVIRONMENT ...] [--keep FOLDER] [-- PYTEST ARGUMENTS]

Each environment is made afresh with this interpreter's venv and pip. `lowest` has every core dependency at the version
that pyproject.toml allows as the lowest; the others have one release of MuJoCo each. The core is what depends on these:
protocol, both clients, server, conformance and Gymnasium environments. Then a client there drives a server of this
interpreter's, which so needs the package, too, and the other way round. Exit code 1 says that something failed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

CORE = (
    *("tests/protocol", "tests/aio", "tests/sync", "tests/server", "tests/conformance"),
    *("tests/integrations/test_gym.py", "tests/integrations/test_vector_env.py"),
)


def lowest() -> list[str]:
    """Return the core dependencies, each at the lowest version allowed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    return [re.sub(r">=(\d+\.\d+)$", r"==\1.0", requirement) for requirement in project["dependencies"]]


def environments() -> dict[str, list[str]]:
    """Return what to install beside the package, by environment."""
    return {
        "mujoco-3.8": ["mujoco==3.8.*"],
        "mujoco-3.11": ["mujoco==3.11.*"],
        "mujoco-newest": ["mujoco"],
        "lowest": lowest(),
    }


def make(folder: Path, requirements: list[str]) -> Path:
    """Make an environment; return its interpreter."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)  # noqa: S603
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*command, "-e", f"{ROOT}[test]", *requirements], check=True)  # noqa: S603
    return python


def versions(python: Path) -> str:
    """Return what is installed there of the core dependencies."""
    listed = subprocess.run(  # noqa: S603
        [str(python), "-m", "pip", "list", "--format", "json", "--disable-pip-version-check"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    core = {re.split(r"[<>=!~ ]", requirement)[0] for requirement in lowest()}
    return ", ".join(f"{one['name']} {one['version']}" for one in json.loads(listed) if one["name"] in core)


def main() -> int:
    parser = argparse.ArgumentParser(description="Run the core tests with other versions of the core dependencies.")
    parser.add_argument("environments", nargs="*", metavar="ENVIRONMENT", help=", ".join(environments()))
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the environments there, and use them again")
    ours, pytest = split(sys.argv[1:])
    arguments = parser.parse_args(ours)
    known = environments()
    if unknown := set(arguments.environments) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}. There are {', '.join(known)}.")
    failed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="urlab-versions-") as scratch:
        folder = (arguments.keep or Path(scratch)).absolute()
        for name in arguments.environments or known:
            started = time.monotonic()
            python = make(folder / name, known[name])
            print(f"=== {name}: {versions(python)}", flush=True)
            done = subprocess.run(  # noqa: S603
                [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", *(pytest or CORE)], cwd=ROOT, check=False
            )
            print(f"=== {name}: exit code {done.returncode}, {time.monotonic() - started:.0f} s", flush=True)
            if done.returncode:
                failed.append(name)
            for client, server in ((str(python), sys.executable), (sys.executable, str(python))):
                done = subprocess.run([client, "tools/drive_other_release.py", server], cwd=ROOT, check=False)  # noqa: S603
                if done.returncode:
                    failed.append(f"{name} with {sys.executable}")
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return what stands before and after `--`."""
    at = arguments.index("--") if "--" in arguments else len(arguments)
    return arguments[:at], arguments[at + 1 :]


if __name__ == "__main__":
    sys.exit(main())
