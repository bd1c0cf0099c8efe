"""Imports between the layers point one way, whether they are made at import, in a function or for type checkers."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "urlab_client"

# Layer -> the layers it may import besides itself. The empty name is the public package, `urlab_client` itself.
VALUES = frozenset({"enums", "errors", "values"})
ALLOWED: dict[str, frozenset[str]] = {
    "enums": frozenset(),
    "errors": frozenset({"enums", "values"}),
    "values": frozenset({"_installation", "enums", "errors"}),
    "protocol": VALUES,
    "events": VALUES | {"protocol"},
    "types": VALUES | {"aio", "protocol"},
    "keys": frozenset({"errors"}),
    "_platform": frozenset(),
    "_sandbox": frozenset({"_platform"}),
    "_mujoco": frozenset(),
    "_installation": frozenset(),
    "aio": VALUES | {"_installation", "events", "_mujoco", "_platform", "_sandbox", "keys", "protocol"},
    "sync": VALUES | {"_platform", "aio", "events", "protocol", "types"},
    "randomise": VALUES | {"_mujoco", "protocol"},
    "simulation": VALUES | {"_mujoco", "_platform", "protocol", "randomise"},
    "server": VALUES
    | {"_installation", "_mujoco", "_platform", "_sandbox", "keys", "protocol", "randomise", "simulation"},
    "": VALUES | {"_installation", "aio", "events", "protocol", "sync", "types"},
    "integrations": VALUES
    | {
        "",
        "_installation",
        "_mujoco",
        "_platform",
        "aio",
        "events",
        "keys",
        "protocol",
        "randomise",
        "server",
        "simulation",
        "sync",
    },
    "cluster": VALUES | {"_installation", "_platform", "integrations", "protocol", "sync", "types"},
    "console": VALUES | {"_installation", "_mujoco", "aio", "events", "integrations", "protocol", "types"},
    "web": VALUES | {"_installation", "aio", "console", "events", "integrations", "protocol", "types"},
    "mcp": VALUES | {"_installation", "aio", "console", "integrations", "protocol", "types", "web"},
    "conformance": VALUES | {"_installation", "aio", "keys", "protocol"},
    "cli": VALUES
    | {
        "",
        "_installation",
        "_mujoco",
        "_platform",
        "aio",
        "conformance",
        "console",
        "events",
        "integrations",
        "keys",
        "mcp",
        "protocol",
        "randomise",
        "server",
        "simulation",
        "sync",
        "types",
        "web",
    },
    "__main__": frozenset({"cli"}),
}

# Inside the two large layers, too: a room (a package, or a module beside the packages) imports those before it only.
ROOMS: dict[str, tuple[str, ...]] = {
    "aio": (
        "background",
        "features",
        "client_types",
        "defaults",
        "arguments",
        "transport",
        "launch",
        "session",
        "streams",
        "model",
        "controllers",
        "cameras",
        "articulation",
        "state",
        "motion",
        "explain",
        "namespaces",
        "client_state",
        "client",
        "",
    ),
    "server": (
        "dialects",
        "system",
        "limits",
        "refusal",
        "assets",
        "compile",
        "editor",
        "render",
        "physics",
        "transport",
        "streams",
        "faults",
        "core",
        "rpc",
        "handlers",
        "open_server",
        "simulated",
        "",
    ),
}

# These are pure: they turn values into bytes and back, and leave waiting, threads and sockets to others.
PURE = frozenset({"enums", "errors", "protocol", "values"})
NO_IO = frozenset(
    {"anyio", "asyncio", "concurrent", "multiprocessing", "selectors", "socket", "subprocess", "threading", "zmq"}
)


def layer_of(file: Path, package: Path) -> str:
    top = file.relative_to(package).parts[0]
    return "" if top == "__init__.py" else top.removesuffix(".py")


def imports(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield line and name of each import: `m` for `import m`, `m.n` for `from m import n`; `n` may be a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = "." * node.level + (f"{node.module}." if node.module else "")
            yield from ((node.lineno, f"{start}{alias.name}") for alias in node.names)


@dataclass
class Facts:
    """What the tests ask of a module."""

    imports: list[tuple[int, str]]
    private: set[str]
    """Private functions and methods that it defines, and private attributes that it sets."""


@cache
def facts(file: Path) -> Facts:
    tree = ast.parse(file.read_text(encoding="utf-8"), str(file))
    names = {
        node.attr if isinstance(node, ast.Attribute) else node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        or (isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store))
    }
    return Facts([*imports(tree)], {name for name in names if name.startswith("_")})


def target_of(imported: str, package: Path) -> str | None:
    """Return the layer that an imported name belongs to, None for another distribution's."""
    name, *rest = imported.split(".")
    if name != package.name:
        return None
    top = rest[0] if rest else ""
    return top if (package / top).is_dir() or (package / f"{top}.py").is_file() else ""


def room_of(module: str, layer: str) -> str:
    """Return the room of a module `urlab_client.LAYER.ROOM…`; the empty name is the layer itself."""
    parts = module.split(".")[2:]
    return parts[0] if parts and parts[0] in ROOMS[layer] else ""


def room_violations(package: Path) -> list[str]:
    found: list[str] = []
    for layer, order in ROOMS.items():
        for file in sorted((package / layer).rglob("*.py")):
            relative = file.relative_to(package / layer)
            room = relative.parts[0].removesuffix(".py").removesuffix("__init__")
            where = file.relative_to(package.parent).as_posix()
            if room not in order:
                found.append(f"{where}: {room} is not a room of {layer}; say in {Path(__file__).name} where it belongs")
                continue
            for line, imported in facts(file).imports:
                if not imported.startswith(f"{package.name}.{layer}."):
                    continue
                target = room_of(imported, layer)
                if target != room and order.index(target) >= order.index(room):
                    found.append(f"{where}:{line}: {layer}/{room} imports {imported}, which stands above it")
    return found


def violations(package: Path) -> list[str]:
    found: list[str] = []
    for file in sorted(package.rglob("*.py")):
        layer = layer_of(file, package)
        where = file.relative_to(package.parent).as_posix()
        if layer not in ALLOWED:
            found.append(f"{where}: {layer} is not a layer; say in {Path(__file__).name} what it may import")
            continue
        for line, imported in facts(file).imports:
            target = target_of(imported, package)
            if imported.startswith("."):
                found.append(f"{where}:{line}: relative import of {imported}")
            elif target is None:
                if layer in PURE and imported.partition(".")[0] in NO_IO:
                    found.append(f"{where}:{line}: {layer} imports {imported}, but does no I/O")
            elif target != layer and target not in ALLOWED[layer]:
                found.append(f"{where}:{line}: {layer or package.name} imports {imported}")
    return found


def test_imports_point_one_way() -> None:
    assert violations(PACKAGE) == []


def test_integrations_use_the_public_server() -> None:
    public = {"SimulatedServer", "ServedRequest"}
    inside = [
        f"{file.relative_to(PACKAGE).as_posix()}:{line}: {imported}"
        for file in sorted((PACKAGE / "integrations").rglob("*.py"))
        for line, imported in facts(file).imports
        if imported.startswith("urlab_client.server.") and imported.rpartition("urlab_client.server.")[2] not in public
    ]
    assert inside == []


def test_imports_inside_the_large_layers_point_one_way() -> None:
    assert room_violations(PACKAGE) == []


# What stands on the client uses its public API alone.
ON_THE_CLIENT = ("integrations", "cluster", "console", "web", "mcp", "cli")
# Public by the reference all the same.
PUBLIC_ALL_THE_SAME = frozenset({"_data_lock"})


def private_names(package: Path) -> set[str]:
    """Return the private attributes that the objects of both clients have."""
    files = (file for flavour in ("aio", "sync") for file in (package / flavour).rglob("*.py"))
    return set().union(*(facts(file).private for file in files))


def private_uses(package: Path) -> list[str]:
    """Return where code that stands on the client reaches into one of its objects."""
    private = private_names(package) - PUBLIC_ALL_THE_SAME
    found: list[str] = []
    for file in sorted(file for layer in ON_THE_CLIENT for file in (package / layer).rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if private.isdisjoint(re.findall(r"(?<!\bself)(?<!\bcls)\.\s*(\w+)", text)):
            continue  # parsing takes long
        for node in ast.walk(ast.parse(text, str(file))):
            if not isinstance(node, ast.Attribute) or node.attr not in private or node.attr.startswith("__"):
                continue
            if not (isinstance(node.value, ast.Name) and node.value.id in {"self", "cls"}):
                found.append(f"{file.relative_to(package.parent).as_posix()}:{node.lineno}: {ast.unparse(node)}")
    return found


def test_what_stands_on_the_client_uses_its_public_attributes() -> None:
    assert private_uses(PACKAGE) == []


def test_a_private_attribute_of_the_client_is_found(tmp_path: Path) -> None:
    package = tmp_path / "urlab_client"
    for file, source in {
        "aio/client.py": "class C:\n    def __init__(self):\n        self._state = 1\n    def _keep(self): ...\n",
        "web/a.py": "def f(self, client):\n    client._keep()\n    return client._data_lock, self.client._state\n",
    }.items():
        (package / file).parent.mkdir(parents=True)
        (package / file).write_text(source)
    assert private_uses(package) == [
        "urlab_client/web/a.py:2: client._keep",
        "urlab_client/web/a.py:3: self.client._state",
    ]


def test_every_room_with_a_place_exists() -> None:
    for layer, order in ROOMS.items():
        rooms = {path.name.removesuffix(".py").removesuffix("__init__") for path in (PACKAGE / layer).iterdir()}
        assert rooms - {"__pycache__"} >= set(order)


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        (
            "server/physics/a.py",
            "from urlab_client.server.handlers.scene import x\n",
            "server/physics/a.py:1: server/physics imports urlab_client.server.handlers.scene.x, which stands above it",
        ),
        (
            "aio/session/session.py",
            "def f():\n    from urlab_client.aio import client\n",
            "aio/session/session.py:2: aio/session imports urlab_client.aio.client, which stands above it",
        ),
        ("server/attic/a.py", "", "server/attic/a.py: attic is not a room of server"),
    ],
)
def test_an_import_from_a_higher_room_is_found(tmp_path: Path, file: str, source: str, complaint: str) -> None:
    package = tmp_path / "urlab_client"
    path = package / file
    path.parent.mkdir(parents=True)
    path.write_text(source)
    (found,) = room_violations(package)
    assert found.startswith(f"urlab_client/{complaint}")


def test_every_layer_with_a_rule_exists() -> None:
    assert {layer_of(file, PACKAGE) for file in PACKAGE.rglob("*.py")} == ALLOWED.keys()


@pytest.mark.parametrize(
    ("file", "source", "complaint"),
    [
        (
            "aio/client.py",
            "import os\nfrom urlab_client.sync import x\n",
            "aio/client.py:2: aio imports urlab_client.sync.x",
        ),
        ("aio/client.py", "from urlab_client import sync\n", "aio/client.py:1: aio imports urlab_client.sync"),
        (
            "aio/client.py",
            "from urlab_client import URLabClient\n",
            "aio/client.py:1: aio imports urlab_client.URLabClient",
        ),
        (
            "aio/client.py",
            "import urlab_client.server.editor.world as w\n",
            "aio/client.py:1: aio imports urlab_client.server.editor.world",
        ),
        ("sync/a.py", "from urlab_client.server import x\n", "sync/a.py:1: sync imports urlab_client.server.x"),
        (
            "server/a.py",
            "def f():\n    from urlab_client.aio import x\n",
            "server/a.py:2: server imports urlab_client.aio.x",
        ),
        (
            "protocol/deep/a.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from urlab_client.aio.client import C\n",
            "protocol/deep/a.py:3: protocol imports urlab_client.aio.client.C",
        ),
        ("protocol/a.py", "import asyncio.events\n", "protocol/a.py:1: protocol imports asyncio.events, but"),
        ("protocol/a.py", "from zmq import Socket\n", "protocol/a.py:1: protocol imports zmq.Socket, but does no I/O"),
        (
            "__init__.py",
            "from urlab_client.server import x\n",
            "__init__.py:1: urlab_client imports urlab_client.server.x",
        ),
        ("aio/a.py", "from . import b\n", "aio/a.py:1: relative import of .b"),
        ("gadgets/a.py", "", "gadgets/a.py: gadgets is not a layer"),
    ],
)
def test_a_wrong_import_is_found_where_it_stands(tmp_path: Path, file: str, source: str, complaint: str) -> None:
    package = tmp_path / "urlab_client"
    for layer in ("protocol", "aio", "sync", "server", "cli"):
        (package / layer).mkdir(parents=True)
        (package / layer / "fine.py").write_text("from urlab_client.protocol import anything\nimport numpy\n")
    path = package / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(source)
    (found,) = violations(package)
    assert found.startswith(f"urlab_client/{complaint}")
