"""What `import urlab_client` costs and needs: no MuJoCo, no OpenGL, no socket, no thread."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

REPORT = """
import json, sys, threading
opened = []
sys.addaudithook(lambda event, args: opened.append(event) if event in ("socket.__new__", "subprocess.Popen") else None)
import {module}
from gc import get_objects
zmq = sys.modules.get("zmq")
print(json.dumps({{
    "modules": sorted(name.partition(".")[0] for name in sys.modules),
    "own": sorted(name for name in sys.modules if name.startswith("urlab_client")),
    "opened": opened,
    "threads": threading.active_count(),
    "contexts": 0 if zmq is None else sum(isinstance(thing, zmq.Context) for thing in get_objects()),
}}))
"""


def after_import(module: str, **environment: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", REPORT.format(module=module)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, **environment},
    )
    assert (done.returncode, done.stderr) == (0, "")
    return json.loads(done.stdout)


@pytest.mark.parametrize("module", ["urlab_client.sync", "urlab_client.aio", "urlab_client.enums", "urlab_client.cli"])
def test_an_import_is_light_and_silent(module: str) -> None:
    # MuJoCo's own import fails with such a value: so the clients need neither it nor OpenGL until they get a model.
    report = after_import(module, MUJOCO_GL="garbage")
    assert not {"mujoco", "OpenGL", "glfw", "matplotlib", "rich", "gymnasium"} & set(report["modules"])
    assert not [name for name in report["own"] if name.startswith("urlab_client.server")]
    assert (report["opened"], report["contexts"], report["threads"]) == ([], 0, 1)


def test_the_package_loads_nothing_before_a_name_is_asked_for() -> None:
    report = after_import("urlab_client")
    assert report["own"] == ["urlab_client"]
    assert not {"asyncio", "msgspec", "numpy", "zmq"} & set(report["modules"])
    report = after_import("urlab_client; urlab_client.NoEngine")
    assert not [name for name in report["own"] if name.startswith(("urlab_client.aio", "urlab_client.sync"))]


def test_a_name_is_what_type_checkers_are_told_it_is() -> None:
    import urlab_client

    tree = ast.parse(Path(urlab_client.__file__).read_text())
    told: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("urlab_client"):
            for alias in node.names:
                told.add(alias.name)
                assert getattr(urlab_client, alias.name) is getattr(import_module(str(node.module)), alias.name)
    assert told == set(urlab_client.__all__) - {"__version__"}
    assert told <= set(dir(urlab_client))
    assert len(urlab_client.__all__) <= 60
    assert urlab_client.aio is import_module("urlab_client.aio")  # as after any import of the package's names


@pytest.mark.parametrize("home", ["enums", "errors", "events", "types"])
def test_names_of_the_public_modules_can_be_imported_from_the_package_too(home: str) -> None:
    import urlab_client

    module = import_module(f"urlab_client.{home}")
    for name in module.__all__:
        if name in {"RPC_ERRORS", "UNCLAIMED", "rpc_error"}:
            continue  # for the protocol
        assert getattr(urlab_client, name) is getattr(module, name)
        assert (name in dir(urlab_client)) == (name in urlab_client.__all__)


def test_the_tree_of_exceptions_is_that_of_the_docstring() -> None:
    from urlab_client import errors

    shown: dict[str, str] = {}
    above: list[str] = []
    for line in (errors.__doc__ or "").splitlines():
        name = line.split()[0].rstrip(",") if line.startswith("    ") else ""
        depth = (len(line) - len(line.lstrip())) // 4
        if isinstance(getattr(errors, name, None), type):
            above[depth - 1 :] = [name]
            shown[name] = above[-2] if depth > 1 else ""
    classes = {
        name: value for name, value in vars(errors).items() if isinstance(value, type) and name in errors.__all__
    }
    per_code = {cls.__name__ for cls in errors.RPC_ERRORS.values()}
    assert set(shown) == (set(classes) - per_code) | {"SessionTakenOver", "NoActiveManager"}
    for name, parent in shown.items():
        assert not parent or issubclass(classes[name], classes[parent])


def test_all_names_can_be_imported_with_a_star() -> None:
    names: dict[str, Any] = {}
    exec("from urlab_client import *", names)
    import urlab_client

    assert set(urlab_client.__all__) <= set(names)


def test_the_protocol_alone_needs_no_transport() -> None:
    report = after_import("urlab_client.protocol.registry, urlab_client.protocol.codec, urlab_client.protocol.rows")
    assert "urlab_client.protocol.registry" in report["own"]


def test_the_console_loads_no_web_framework() -> None:
    report = after_import("urlab_client.console.session")
    assert not {"starlette", "uvicorn", "mcp"} & set(report["modules"])
    assert not [name for name in report["own"] if name.startswith(("urlab_client.web", "urlab_client.server"))]


def test_the_public_names_are_the_documented_ones() -> None:
    import urlab_client
    import urlab_client.aio

    for package in (urlab_client, urlab_client.aio):
        assert len(set(package.__all__)) == len(package.__all__)
        for name in package.__all__:
            assert getattr(package, name) is not None
        assert not [name for name in package.__all__ if name.startswith("_") and name != "__version__"]
    # Two flavours, one set of names for what a client hands out.
    shared = set(urlab_client.aio.__all__)
    assert shared <= set(urlab_client.__all__)


def test_the_version_is_that_of_the_distribution() -> None:
    from importlib.metadata import version

    import urlab_client

    assert urlab_client.__version__ == version("urlab-client")
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = urlab_client.nonsense  # type: ignore[attr-defined]


def test_why_a_name_cannot_be_loaded_is_said(tmp_path: Path) -> None:
    # As PyOpenGL does where MUJOCO_GL names a library that is missing. Python hides it: "cannot import name".
    (tmp_path / "mujoco.py").write_text("None.eglQueryString", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", "from urlab_client.server import SimulatedServer"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])},
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("ImportError: cannot load urlab_client.server.simulated: ")
    assert done.stderr.endswith("'NoneType' object has no attribute 'eglQueryString'\n")
