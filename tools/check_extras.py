"""Check that every extra installs without conflicts, alone and together, beside the present viser.

Run: python tools/check_extras.py [EXTRA ...]

All extras of pyproject.toml together come first: the versions that fit for all of them fit for each, too. Only where
there are none, or with `--each`, is every extra looked at alone, which shows the one in the way.

Pip resolves what a fresh environment with the package, the extras and viser holds. Into such an environment goes the
metadata of all of it, without the files, and `pip check` looks there: it reads nothing else, and most of the size is
the files. Viser is held at the version that pip chooses when nothing else is asked for, lest the resolver makes an
extra fit by taking an old one. Exit code 1 says that something does not fit.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
import tomllib
import venv
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
NEIGHBOUR = "viser"
SHOWN = (NEIGHBOUR, "websockets", "rich", "numpy")
"""Packages whose versions the table shows: the neighbour, and what it pins."""

TOGETHER = "all together"
AT_ONCE = 2
DEADLINE_S = 300.0


class Conflict(Exception):
    """What was asked for does not fit together."""


@dataclass(frozen=True)
class Checked:
    """One environment.

    Attributes:
        name: The extra, or extras.
        versions: Version of each package.
        problem: What pip found, or None.
        seconds: How long it took.
    """

    name: str
    versions: dict[str, str]
    problem: str | None
    seconds: float


def main() -> int:
    parser = argparse.ArgumentParser(description="Check that the extras fit together and beside viser.")
    parser.add_argument("extras", nargs="*", help="extras to check, each alone (default: all together)")
    parser.add_argument("--each", action="store_true", help="check each extra alone, too, where all fit together")
    declared = sorted(project()["optional-dependencies"])
    arguments = parser.parse_args()
    chosen: list[str] = arguments.extras
    unknown = sorted(set(chosen) - set(declared))
    if unknown:
        parser.error(f"no such extra: {', '.join(unknown)}; there are {', '.join(declared)}")

    newest = version_of(resolve([NEIGHBOUR]), NEIGHBOUR)
    print(f"beside {NEIGHBOUR} {newest}", flush=True)
    width = max(map(len, [*declared, TOGETHER]))

    def failures(asked: list[list[str]]) -> list[Checked]:
        failed: list[Checked] = []
        with ThreadPoolExecutor(AT_ONCE) as pool:
            for result in pool.map(lambda extras: check(extras, newest), asked):
                shown = "  ".join(f"{name} {result.versions[name]}" for name in SHOWN if name in result.versions)
                size = f"{len(result.versions):3} packages  {result.seconds:5.1f} s"
                print(f"{result.name:<{width}}  {size}  {'FAILED' if result.problem else shown}", flush=True)
                if result.problem:
                    failed.append(result)
        return failed

    failed = [] if chosen else failures([declared])
    if chosen or failed or arguments.each:
        failed += failures([[extra] for extra in chosen or declared])
    for result in failed:
        print(f"\n{result.name}:\n{result.problem}", file=sys.stderr)
    return 1 if failed else 0


def project() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def check(extras: list[str], newest: str) -> Checked:
    """Check an environment with some extras and the neighbour."""
    started = time.monotonic()
    name = extras[0] if len(extras) == 1 else TOGETHER
    versions: dict[str, str] = {}
    problem = None
    try:
        found = resolve([f"{ROOT}[{','.join(extras)}]", f"{NEIGHBOUR}=={newest}"])
        versions = {canonical(entry["name"]): entry["version"] for entry in found}
        pip_check(found)
    except Conflict as conflict:
        problem = str(conflict)
    return Checked(name, versions, problem, time.monotonic() - started)


def resolve(requirements: list[str]) -> list[dict[str, Any]]:
    """Return the metadata of all that pip would install into an empty environment.

    Raises:
        Conflict: Nothing meets the requirements.
    """
    # The package itself is built by what is installed here, which saves an environment for each build.
    with tempfile.TemporaryDirectory(prefix="urlab-extras-") as temporary:
        report = Path(temporary) / "report.json"
        options = ["--dry-run", "--ignore-installed", "--no-build-isolation", "--quiet", "--report", str(report)]
        pip("install", *options, *requirements)
        return [entry["metadata"] for entry in json.loads(report.read_text(encoding="utf-8"))["install"]]


def pip_check(found: list[dict[str, Any]]) -> None:
    """Run `pip check` on an environment with these packages.

    Raises:
        Conflict: It found something.
    """
    with tempfile.TemporaryDirectory(prefix="urlab-extras-") as temporary:
        venv.create(temporary, with_pip=False, symlinks=True)
        site = next(Path(temporary).glob("lib/python*/site-packages"))
        for metadata in found:
            folder = site / f"{canonical(metadata['name']).replace('-', '_')}-{metadata['version']}.dist-info"
            folder.mkdir()
            (folder / "METADATA").write_text(rendered(metadata), encoding="utf-8")
        pip("--python", str(Path(temporary) / "bin" / "python"), "check")


def rendered(metadata: dict[str, Any]) -> str:
    """Return the fields of a METADATA file that say what a package needs."""
    fields = [("Metadata-Version", metadata["metadata_version"])]
    fields += [("Name", metadata["name"]), ("Version", metadata["version"])]
    fields += itertools.product(["Provides-Extra"], metadata.get("provides_extra", []))
    fields += itertools.product(["Requires-Dist"], metadata.get("requires_dist", []))
    return "".join(f"{name}: {value}\n" for name, value in fields)


def pip(*arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    done = subprocess.run(  # noqa: S603  # a fixed command
        command, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    if done.returncode:
        raise Conflict((done.stdout + done.stderr).strip())


def version_of(found: list[dict[str, Any]], name: str) -> str:
    return next(entry["version"] for entry in found if canonical(entry["name"]) == name)


def canonical(name: str) -> str:
    return name.lower().replace("_", "-").replace(".", "-")


if __name__ == "__main__":
    sys.exit(main())
