"""The sources of the blocking façade: which modules are mirrored, and which of their classes need a façade."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import generated
from generated import Refused

Function = ast.FunctionDef | ast.AsyncFunctionDef

# The base class of the façade answers for these.
UNMIRRORED = {
    "__copy__", "__deepcopy__", "__del__", "__eq__", "__getstate__", "__hash__", "__init__", "__init_subclass__",
    "__ne__", "__new__", "__post_init__", "__reduce__", "__reduce_ex__", "__repr__", "__setstate__",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What to generate.

    Attributes:
        package: Folder of the package that has `aio` and `sync`.
        shown: What the paths in headers and messages are relative to.
        modules: Mirrored modules, as patterns below `aio`.
        root: The class that users construct: it owns a portal.
        dropped: Base classes without public members, which façade classes do without.
        local: Base class of the classes that the façade shares.
        renames: What methods are called in the façade; docstrings follow.
    """

    package: Path
    shown: Path
    modules: tuple[str, ...]
    root: str
    dropped: frozenset[str] = frozenset()
    local: str = ""
    renames: Mapping[str, str] = field(default_factory=dict[str, str])


class Module(generated.Source):
    """A mirrored module, and what the names that it imports stand for."""

    def __init__(self, path: Path, plan: Plan) -> None:
        super().__init__(path)
        parts = path.relative_to(plan.package.parent).with_suffix("").parts
        self.name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        self.shown = path.relative_to(plan.shown).as_posix()
        # The mirror of a package below `aio` is one module.
        below = path.relative_to(plan.package / "aio").parts
        self.output = plan.package / "sync" / f"{below[0].removesuffix('.py')}.py"
        self.mirror = f"{plan.package.name}.sync.{self.output.stem}"
        self.alias = "aio" if len(below) == 1 else f"aio_{path.stem.lstrip('_')}"
        self.imports = dict(self._imports())

    def _imports(self) -> Iterator[tuple[str, tuple[str, str, bool]]]:
        """Yield each local name with module, name there (empty for a module), whether for type checkers only."""
        for node in self.tree.body:
            checked = isinstance(node, ast.If) and names_in(node.test) == ["TYPE_CHECKING"]
            for statement in node.body if isinstance(node, ast.If) and checked else [node]:
                match statement:
                    case ast.Import(names=names):
                        yield from ((alias.asname or alias.name, (alias.name, "", checked)) for alias in names)
                    case ast.ImportFrom(module=str(module), names=names, level=0):
                        yield from ((alias.asname or alias.name, (module, alias.name, checked)) for alias in names)
                    case _:
                        pass

    @property
    def exported(self) -> list[str]:
        """The names in `__all__`."""
        node = self.assignments.get("__all__")
        return [] if node is None else ast.literal_eval(node)

    def refuse(self, node: ast.AST, why: str) -> Refused:
        return Refused(f"{self.shown}:{getattr(node, 'lineno', 1)}: {why}")

    def names(self, node: ast.AST | None) -> Iterator[str]:
        """Yield the names in an annotation and, after an alias of this module, those in its definition."""
        for name in names_in(node):
            yield name
            if name in self.assignments:
                yield from names_in(self.assignments[name])


class Sources:
    """All mirrored modules, and which of their classes need a façade."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.modules: dict[str, Module] = {}
        for pattern in plan.modules:
            paths = sorted((plan.package / "aio").glob(pattern))
            if not paths:
                raise Refused(f"{plan.package.relative_to(plan.shown).as_posix()}/aio/{pattern}: no such module")
            found = (Module(path, plan) for path in paths)
            self.modules |= {module.name: module for module in found}
        self.homes: dict[str, Module] = {}
        for module in self.modules.values():
            for name, node in module.classes.items():
                if is_plain(name) and self.homes.setdefault(name, module) is not module:
                    raise module.refuse(node, f"{name} is the name of another mirrored class, too")
        self.facades: set[str] = {plan.root}
        self.shared: set[str] = set()
        while more := {name for name in self.homes if self._needs_facade(name)} - self.facades:
            bases = {base for name in more for base in self._bases(name) if base in self.homes}
            self.facades |= more | {base for base in bases if not self._is_local(base)}
        # Objects of these may be of a façade class.
        self.shared = {base for name in self.facades for base in self.ancestors(name)} - self.facades

    def ancestors(self, name: str) -> Iterator[str]:
        """Yield the mirrored classes that a class is derived from."""
        for base in self._bases(name):
            if base in self.homes:
                yield base
                yield from self.ancestors(base)

    def _is_local(self, name: str) -> bool:
        bases = self._bases(name)
        return self.plan.local in bases or any(base in self.homes and self._is_local(base) for base in bases)

    def _bases(self, name: str) -> list[str]:
        return [base for node in self.homes[name].classes[name].bases for base in names_in(node)[:1]]

    def _needs_facade(self, name: str) -> bool:
        """Whether a class waits, or is derived from, hands out or takes a façade class."""
        members = [node for _, node in self.members(name)]
        return (
            any(isinstance(node, ast.AsyncFunctionDef) for node in members)
            or not self.facades.isdisjoint(self._bases(name))
            or any(self.mentions(self.homes[name], part) for node in members for part in annotations_of(node))
        )

    def members(self, cls: str) -> Iterator[tuple[str, Function | ast.AnnAssign]]:
        """Yield the public members of a class."""
        for node in self.homes[cls].classes[cls].body:
            match node:
                case (
                    ast.FunctionDef(name=name)
                    | ast.AsyncFunctionDef(name=name)
                    | ast.AnnAssign(target=ast.Name(id=name))
                ) if self.is_public(name):
                    yield name, node
                case _:
                    pass

    def is_public(self, name: str) -> bool:
        if name.startswith("__") and name.endswith("__"):
            return name not in UNMIRRORED
        return is_plain(name)

    def mentions(self, module: Module, annotation: ast.expr | None) -> bool:
        return not self.facades.union(self.shared).isdisjoint(module.names(annotation))


def is_plain(name: str) -> bool:
    return not name.startswith("_")


def names_in(node: ast.AST | None) -> list[str]:
    """Return the names in an annotation."""
    match node:
        case None:
            return []
        case ast.Name(id=name):
            return [name]
        case _:
            return [name for child in ast.iter_child_nodes(node) for name in names_in(child)]


def annotations_of(node: Function | ast.AnnAssign) -> list[ast.expr | None]:
    if isinstance(node, ast.AnnAssign):
        return [node.annotation]
    return [node.returns, *(parameter.annotation for parameter in parameters_of(node))]


def parameters_of(node: Function) -> list[ast.arg]:
    args = node.args
    return [*args.args, *args.kwonlyargs, *([args.kwarg] if args.kwarg else [])]


def docstring_of(body: Sequence[ast.stmt]) -> ast.Constant | None:
    match body:
        case [ast.Expr(value=ast.Constant(value=str()) as node), *_]:
            return node
        case _:
            return None
