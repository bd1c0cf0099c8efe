"""The machine that figures were taken on, and the processor time that they took."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import platform
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import zmq

__all__ = ["children", "commit", "describe", "processor_s"]

_PACKAGES = ("mujoco", "msgspec", "numpy", "pyzmq", "anyio", "urlab-client", "uvloop")


def describe() -> dict[str, object]:
    """Return what bears on the figures, and how busy the machine is now."""
    versions: dict[str, str] = {}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "cpu": _cpu(),
        "cores": usable,
        "load": [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None,
        "system": platform.platform(),
        "python": f"{platform.python_version()} {platform.python_implementation()}",
        "switch_interval_s": sys.getswitchinterval(),
        "libzmq": zmq.zmq_version(),
        "packages": versions,
    }


def processor_s() -> float:
    """Return the processor time of this process and of its children, seconds."""
    total = time.process_time()
    for child in children():
        with contextlib.suppress(OSError):
            after_name = Path(f"/proc/{child}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
            total += (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")
    return total


def children() -> list[str]:
    """Return the ids of the processes that this one has started and that still run."""
    found = [path.read_text(encoding="ascii") for path in Path("/proc/self/task").glob("*/children")]
    return " ".join(found).split()


def commit() -> str | None:
    """Return the commit of the checkout, with `+` if files of it were changed since; None outside a repository."""
    try:
        head, changes = (_git("rev-parse", "HEAD").strip(), _git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head}+" if changes else head


def _git(*arguments: str) -> str:
    here = Path(__file__).parent
    return subprocess.run(["git", *arguments], cwd=here, check=True, capture_output=True, text=True).stdout  # noqa: S607


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
