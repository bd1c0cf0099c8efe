"""What is shipped: wheel and source distribution, installed where the repository is not."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Iterator, Sequence
from email import message_from_bytes
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BUILD = "import sys, hatchling.build as b; b.build_wheel(sys.argv[1]); b.build_sdist(sys.argv[1])"
SHIPPED = {".py", ".typed", ".xml", ".png", ".html", ".css", ".js", ".svg", ".toml", ".json", ".webmanifest", ".ico"}


def run(command: Sequence[str | Path], cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run(
        command,
        capture_output=True,
        encoding="utf-8",
        timeout=240,
        check=False,
        cwd=cwd,
        env={**environment, "PYTHONUTF8": "1"},
    )


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel and the source distribution of this checkout."""
    folder = tmp_path_factory.mktemp("dist")
    built = run([sys.executable, "-c", BUILD, folder], ROOT)
    assert built.returncode == 0, built.stderr
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (wheel,) = dist.glob("*.whl")
    return wheel


PROGRAMS = "Scripts" if os.name == "nt" else "bin"


def packages_of(venv: Path) -> Path:
    """Return the folder that a virtual environment has its packages in."""
    (packages,) = venv.glob("Lib/site-packages" if os.name == "nt" else "lib/python*/site-packages")
    return packages


@pytest.fixture(scope="module")
def venv(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a virtual environment that has the wheel, and the dependencies of this one, but not the repository."""
    folder = tmp_path_factory.mktemp("installed")
    for command in (
        [sys.executable, "-m", "venv", "--without-pip", folder],
        [
            sys.executable,
            "-m",
            "pip",
            "--python",
            folder,
            "install",
            "-q",
            "--no-deps",
            "--no-index",
            "--no-compile",
            wheel,
        ],
    ):
        done = run(command, folder)
        assert done.returncode == 0, done.stderr
    packages = packages_of(folder)
    # A path in a .pth file is only searched: editable installations in it have no effect.
    shared = [path for path in sys.path if path.endswith("site-packages")]
    (packages / "dependencies.pth").write_text("".join(f"{path}\n" for path in shared), encoding="utf-8")
    return folder


def sources(*suffixes: str) -> set[str]:
    """Return the files of the packages, below `src/`, that are under version control's eye."""
    files = (path for path in (ROOT / "src").rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return {path.relative_to(ROOT / "src").as_posix() for path in files if not suffixes or path.suffix in suffixes}


def test_the_wheel_has_the_packages_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    info = {name for name in names if name.partition("/")[0].endswith(".dist-info")}
    assert {name.partition("/")[2] for name in info} == {
        "METADATA",
        "RECORD",
        "WHEEL",
        "entry_points.txt",
        "licenses/LICENSE",
    }
    shipped = set(names) - info
    assert len(names) == len(set(names))
    assert {name.partition("/")[0] for name in shipped} == {"urlab_client", "pytest_urlab"}
    assert shipped == sources()
    assert {Path(name).suffix for name in shipped} <= SHIPPED
    assert {"urlab_client/py.typed", "pytest_urlab/py.typed", "urlab_client/server/robots/arm.xml"} <= shipped


def test_the_wheels_metadata(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [name for name in archive.namelist() if name.endswith("/METADATA")]
        metadata = message_from_bytes(archive.read(name))
    assert wheel.name.endswith("-py3-none-any.whl")
    assert (metadata["Name"], metadata["License-Expression"]) == ("urlab-client", "Apache-2.0")
    assert {"demo", "gym", "web"} <= set(metadata.get_all("Provides-Extra") or ())
    required = [line for line in metadata.get_all("Requires-Dist") or () if "extra ==" not in line]
    assert sorted(line.partition(">")[0] for line in required) == ["anyio", "msgspec", "mujoco", "numpy", "pyzmq"]


def test_the_source_distribution_builds_and_tests_itself(dist: Path) -> None:
    (source,) = dist.glob("*.tar.gz")
    with tarfile.open(source) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "mkdocs.yml",
        "tools/gen_sync.py",
        "tests/conftest.py",
    }
    assert wanted <= names
    assert {f"src/{name}" for name in sources()} <= names
    assert {name.partition("/")[0] for name in names if "/" in name} == {
        "benchmarks",
        "docs",
        "examples",
        "src",
        "tests",
        "tools",
        "typings",
    }
    assert not [name for name in names if "__pycache__" in name or name.endswith((".pyc", ".log", "MUJOCO_LOG.TXT"))]


def test_the_citation_names_the_same_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_no_extra_admits_a_starlette_with_a_known_defect() -> None:
    """CVE-2025-62727: up to 0.49.0 a Range header takes quadratic time, and the console serves files."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"].items()
    bounds = {extra: name for extra, names in extras for name in names if name.startswith("starlette")}
    assert bounds == dict.fromkeys(("mcp", "web", "test"), "starlette>=0.49.1")


def test_actions_of_others_are_pinned_by_commit() -> None:
    """A tag can be moved to other code."""
    workflows = [file.read_text(encoding="utf-8") for file in (ROOT / ".github" / "workflows").glob("*.y*ml")]
    used = [line for text in workflows for line in text.splitlines() if re.match(r"\s*(- )?uses:", line)]
    assert [line for line in used if not re.search(r"@[0-9a-f]{40} # v[0-9]+\.[0-9]+\.[0-9]+$", line)] == []


DRIVE = r"""
import urlab_client
with urlab_client.URLabClient("sim://ball", step_mode="direct") as client:
    client.discover()
    client.step(100)
    print(f"{client.sim_time:.1f}", urlab_client.__file__, urlab_client.__version__, sep="\n")
"""


def test_the_wheel_works_without_the_repository(venv: Path, tmp_path: Path) -> None:
    done = run([venv / PROGRAMS / "python", "-W", "error", "-c", DRIVE], tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    time, file, version = done.stdout.splitlines()
    assert time == "0.2"
    assert Path(file).is_relative_to(venv)
    assert run([venv / PROGRAMS / "urlab", "--version"], tmp_path).stdout == f"urlab_client {version}\n"


@pytest.fixture
def rival(venv: Path) -> Iterator[Path]:
    """Install a distribution of another name that says it brings a package `urlab_client`."""
    packages = packages_of(venv)
    info = packages / "other_bridge-1.0.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-bridge\nVersion: 1.0\n", encoding="utf-8")
    (info / "RECORD").write_text("urlab_client/__init__.py,,\n", encoding="utf-8")
    yield packages
    shutil.rmtree(info)


def test_the_doctor_names_a_package_in_the_way(venv: Path, rival: Path, tmp_path: Path) -> None:
    done = run([venv / PROGRAMS / "urlab", "doctor", "tcp://127.0.0.1:9", "--timeout=0.1"], tmp_path)
    assert "other-bridge also installs a package urlab_client" in done.stderr
    assert "pip uninstall -y other-bridge urlab-client" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_broken_import_names_the_package_in_the_way(venv: Path, rival: Path, tmp_path: Path) -> None:
    file = rival / "urlab_client" / "aio" / "session" / "session.py"
    own = file.read_bytes()
    command = [venv / PROGRAMS / "python", "-c", "from urlab_client import URLabClient"]
    try:
        file.write_text("", encoding="utf-8")
        done = run(command, tmp_path)
        assert "cannot load urlab_client.URLabClient: other-bridge also installs a package urlab_client" in done.stderr
        (rival / "other_bridge-1.0.dist-info" / "RECORD").unlink()
        done = run(command, tmp_path)
        assert done.stderr.splitlines()[-1].startswith("ImportError: cannot import name")
    finally:
        file.write_bytes(own)
