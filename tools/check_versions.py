"""Run the core of the test suite with other versions of what the package stands on.

Run: python tools/check_versions.py [ENVIRONMENT ...] [--quick] [--keep FOLDER] [-- PYTEST ARGUMENTS]

Each environment is made with uv where that is installed, otherwise with pip, for this interpreter's release of Python.
`lowest` has every core dependency at the version that pyproject.toml allows as the lowest; `mujoco-…` one release of
MuJoCo. There the core is tested, what depends on these: protocol, both clients, server, conformance and Gymnasium
environments. `lowest-extras` has all that the extras bring at the lowest versions, and runs a file of tests for each.
Then a client there drives a server of this interpreter's, which so needs the package, too, and the other way round.
Exit code 1 says that something failed.

With --quick, for CI, which runs the whole suite with the newest MuJoCo: `lowest`, whose MuJoCo is the oldest, of the
release between what steps simulations and environments, and `lowest-extras` without the extras that take gigabytes.

Asyncio's debug mode is on here, as nowhere else: it costs time, and nothing in it depends on a version.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DRIVE = ROOT / "tools" / "drive_other_release.py"

FROM_END_TO_END = (
    *("tests/test_mujoco_releases.py", "tests/conformance"),
    *("tests/integrations/test_gym.py", "tests/integrations/test_vector_env.py"),
)
CORE = (*FROM_END_TO_END, "tests/server", "tests/protocol", "tests/aio", "tests/sync")

SMOKE = {
    "coacd": "tests/server/test_decomposition.py",
    "completion": "tests/cli/test_cli_usage.py",
    "dataset": "tests/integrations/test_record_export.py",
    "demo": "tests/cli/test_cli_demo.py",
    "foxglove": "tests/integrations/test_view.py",
    "gym": "tests/integrations/test_gym.py",
    "mcap": "tests/integrations/test_record.py",
    "mcp": "tests/mcp/test_transports.py",
    "onnx": "tests/integrations/test_policy_trained.py",
    "opentelemetry": "tests/integrations/test_telemetry.py",
    "pillow": "tests/protocol/test_picture_files.py",
    "prometheus": "tests/integrations/test_telemetry.py",
    "ray": "tests/integrations/test_cluster.py",
    "rerun": "tests/integrations/test_view.py",
    "rsl-rl": "tests/integrations/test_rsl_rl.py",
    "sb3": "tests/integrations/test_sb3.py",
    "teleop": "tests/integrations/test_teleop.py",
    "train": "tests/integrations/test_policy_trained.py",
    "video": "tests/integrations/test_record_export.py",
    "warp": "tests/integrations/test_warp_batch.py",
    "web": "tests/web/test_web_servers.py",
}
"""Tests of each extra that users install for what it does at run time."""

LOWEST = re.compile(r">=([\d.]+)[^;]*")
"""What a requirement says of versions; the lowest is in the group."""

GIGABYTES = {"ray", "rsl-rl", "sb3", "warp"}
LIGHT = SMOKE.keys() - GIGABYTES
QUICK = {
    "lowest": CORE,
    "mujoco-3.11": (
        "tests/test_mujoco_releases.py",
        "tests/conformance/test_driving.py",
        "tests/integrations/test_gym.py",
        "tests/integrations/test_vector_env.py",
    ),
    "lowest-light-extras": tuple(sorted({SMOKE[extra] for extra in LIGHT})),
}
TESTS = {
    "lowest-light-extras": QUICK["lowest-light-extras"],
    "lowest-extras": ("-m", "not browser and not long and not matrix", *sorted(set(SMOKE.values()))),
}
"""What runs in an environment, if not the core."""

# What the core's tests use of the extra `test`; the rest is for integrations, and takes long to install.
TESTS_NEED = {"coacd", "gymnasium", "hypothesis", "mcap", "pillow", "trio", "uvloop"}


def project() -> dict[str, Any]:
    """Return what pyproject.toml says of the project."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def name(requirement: str) -> str:
    """Return the package that a requirement is for."""
    return re.split(r"[<>=!~; ]", requirement)[0]


def lowest() -> list[str]:
    """Return the core dependencies, each at the lowest version allowed."""
    return [re.sub(r">=(\d+\.\d+)$", r"==\1.0", requirement) for requirement in project()["dependencies"]]


def lowest_of(extras: Iterable[str]) -> list[str]:
    """Return what extras bring, each at the lowest version allowed."""
    declared = project()["optional-dependencies"]
    return sorted({LOWEST.sub(r"==\1", one) for extra in extras for one in declared[extra]})


def environments() -> dict[str, list[str]]:
    """Return what to install beside the package, by environment."""
    return {
        "mujoco-3.8": ["mujoco==3.8.*"],
        "mujoco-3.10": ["mujoco==3.10.*"],
        "mujoco-3.11": ["mujoco==3.11.*"],
        "mujoco-newest": ["mujoco"],
        "lowest": lowest(),
        "lowest-light-extras": lowest_of(LIGHT),
        "lowest-extras": lowest_of(SMOKE),
    }


def make(folder: Path, requirements: list[str]) -> Path:
    """Make an environment; return its interpreter."""
    tests, all_of_them = project()["optional-dependencies"]["test"], "extras" in folder.name
    needed = [one for one in tests if all_of_them or name(one) in TESTS_NEED or name(one).startswith("pytest")]
    python = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    if uv := shutil.which("uv"):
        commands = [
            [uv, "venv", "--quiet", "--allow-existing", "--python", sys.executable, str(folder)],
            [uv, "pip", "install", "--quiet", "--python", str(python)],
        ]
    else:
        commands = [
            [sys.executable, "-m", "venv", str(folder)],
            [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"],
        ]
    subprocess.run(commands[0], check=True)  # noqa: S603
    subprocess.run([*commands[1], "-e", str(ROOT), *needed, *requirements], check=True)  # noqa: S603
    return python


def versions(python: Path) -> str:
    """Return what is installed there of Python and the core dependencies."""
    program = (
        "import platform, sys; from importlib.metadata import version\n"
        "print(*(f'{one} {version(one)},' for one in sys.argv[1:]), 'Python', platform.python_version())"
    )
    core = [name(requirement) for requirement in lowest()]
    done = subprocess.run([str(python), "-c", program, *core], capture_output=True, text=True, check=True)  # noqa: S603
    return done.stdout.strip()


def main() -> int:
    parser = argparse.ArgumentParser(description="Run the core tests with other versions of the core dependencies.")
    parser.add_argument("environments", nargs="*", metavar="ENVIRONMENT", help=", ".join(environments()))
    parser.add_argument("--quick", action="store_true", help=f"what CI runs: {', '.join(QUICK)}")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the environments there, and use them again")
    ours, pytest = split(sys.argv[1:])
    arguments = parser.parse_args(ours)
    known = environments()
    if unknown := set(arguments.environments) - set(known):
        parser.error(f"unknown: {', '.join(sorted(unknown))}. There are {', '.join(known)}.")
    if arguments.quick and arguments.environments:
        parser.error("--quick has environments of its own")
    named = arguments.environments or [one for one in known if "extras" not in one]
    chosen = QUICK if arguments.quick else {one: TESTS.get(one, CORE) for one in named}
    failed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="urlab-versions-") as scratch:
        folder = (arguments.keep or Path(scratch)).absolute()
        with ThreadPoolExecutor(1) as maker:  # the next are made while the first is tested
            made = {one: maker.submit(make, folder / one, known[one]) for one in chosen}
            for environment, tests in chosen.items():
                failed += check(environment, made[environment].result(), pytest or [*tests])
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def check(environment: str, python: Path, pytest: list[str]) -> list[str]:
    """Run tests in an environment, and drive servers between it and this one; return what failed."""
    started = time.monotonic()
    print(f"=== {environment}: {versions(python)}", flush=True)
    tests = [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", "-o", "asyncio_debug=true", *pytest]
    if "extras" in environment:  # old releases use what newer ones of their own dependencies deprecate
        tests += ["-W", "ignore::DeprecationWarning"]
    commands = {f"{environment}: pytest": tests}
    for client, server in ((str(python), sys.executable), (sys.executable, str(python))):
        commands[f"{environment}: client of {client}, server of {server}"] = [client, str(DRIVE), server]
    failed = [
        what
        for what, command in commands.items()
        if subprocess.run(command, cwd=ROOT, check=False).returncode  # noqa: S603
    ]
    print(f"=== {environment}: {len(failed)} of {len(commands)} failed, {time.monotonic() - started:.0f} s", flush=True)
    return failed


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return what stands before and after `--`."""
    at = arguments.index("--") if "--" in arguments else len(arguments)
    return arguments[:at], arguments[at + 1 :]


if __name__ == "__main__":
    sys.exit(main())
