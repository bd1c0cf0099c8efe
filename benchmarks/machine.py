"""The machine that figures were taken on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import zmq

__all__ = ["commit", "describe"]

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
