"""Draw mutants of the sources at random, and show those that neither the tests nor the type checker notice.

    python tools/sample_mutants.py --record       # now and then: run all tests, and keep which of them run which lines
    python tools/sample_mutants.py --n 100 --seed 7
    python tools/sample_mutants.py --n 100 --seed 7 --only aio/session/turn.py:79 tests/aio/test_turns.py

mutmut's operators make the mutants (`pip install -e '.[mutants]'`). Lines are drawn evenly, so that a package counts by
its size; strings, which are mostly prose, annotations and generated files are left alone. The tests that run a mutant's
line run in a copy of the tree until one fails: for half of `--seconds` of processor time those whose own text shares
words with the line, the rarest first; then quick ones, and one case of each function before the others. A failure
counts if that test passes without the mutant; hanging counts, too. Of what passes, pyright, where it is installed, is
asked as in CI; what it reports is counted in a column of its own. equivalent_mutants.toml has those that make no
difference, with the reason. They are not counted.
The record lies in `.mutants/`, with the sources of its time, by which it serves later commits.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import functools
import itertools
import json
import os
import queue
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = "src/urlab_client"
RECORD = ".mutants"
EQUIVALENT = Path(__file__).with_name("equivalent_mutants.toml")

RECORDED = "not browser and not matrix"  # also what takes long: some of the code runs nowhere else
STRUCK = (  # tests that raise exceptions in threads at any moment, also while coverage holds its lock: then all wait
    "tests/server/test_health.py",
    "tests/sync/test_portal.py::TestInterrupt",
    "tests/process/test_interrupts.py",
)
DECLARED = (  # tests that read what modules declare, of which no coverage tells: for all that runs on import
    "tests/test_declarations.py",
    "tests/protocol/test_registry.py",
    "tests/docs/test_docs_reference.py::test_it_is_current",
    "tests/tools/test_gen_sync.py::test_what_is_checked_in_is_current",
    "tests/reference/test_reference.py",
)
TEST_S, RUN_S = 120, 900  # others use the machine, too
MEMORY = 8 << 30  # a mutant may ask for more and more of it
PASSED, FAILED = 0, 1  # exit codes of pytest
WORD = re.compile(r"[A-Za-z_]\w{3,}")

# Files of what pytest notes for a record, and for a mutant. It loads this module with `-p`.
TIMES, CAUGHT_BY = "SAMPLE_MUTANTS_TIMES", "SAMPLE_MUTANTS_CAUGHT_BY"


def pytest_configure() -> None:
    """Limit what a mutant may use, and spend no time on a smaller example of what it breaks."""
    if CAUGHT_BY in os.environ:
        import resource

        from hypothesis import Phase, settings

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        phases = [phase for phase in Phase if phase.name not in {"shrink", "explain"}]
        settings.register_profile("mutant", settings(), phases=phases, database=None)
        settings.load_profile("mutant")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, Any]:
    """Tell coverage which test runs, and note what it takes: of the processors, and a quarter of what it waits."""
    if TIMES not in os.environ:
        return (yield)
    from coverage import Coverage

    if (measuring := Coverage.current()) is not None:
        measuring.switch_context(item.nodeid)
    began = os.times()
    try:
        return (yield)
    finally:
        *processor, lasted = (end - begin for begin, end in zip(began, os.times(), strict=True))
        _note(os.environ[TIMES], item.nodeid, max(sum(processor), lasted / 4))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note which test failed."""
    if report.failed and (path := os.environ.get(CAUGHT_BY) or os.environ.get(TIMES)):
        _note(path, report.nodeid)


def _note(path: str, *what: object) -> None:
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(what) + "\n")


RC = """
[run]
source = {root}/src/urlab_client
data_file = {folder}/data
parallel = true
context = ${{PYTEST_CURRENT_TEST-}}
patch = _exit
"""


def record(root: Path, tests: Sequence[str]) -> None:
    """Run tests under coverage, with the processes that they start, and keep what is measured."""
    from coverage import Coverage

    shutil.rmtree(root / RECORD, ignore_errors=True)
    folder = root / RECORD
    shutil.copytree(root / "src", folder / "src", ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "rc").write_text(RC.format(root=root, folder=folder), encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
    environment |= {"PYTHONPATH": f"{root}/src:{root}/tools", TIMES: f"{folder}/times"}
    environment["COVERAGE_PROCESS_START"] = f"{folder}/rc"
    command = [sys.executable, "-m", "pytest", "-q", "-m", RECORDED, "-p", "sample_mutants", *tests]
    command += [f"--deselect={struck}" for struck in STRUCK]
    if subprocess.run(command, cwd=root, env=environment, check=False).returncode not in {PASSED, FAILED}:  # noqa: S603
        raise SystemExit("the tests cannot run")
    Coverage(config_file=str(folder / "rc")).combine()


class Record:
    """What a run of the tests under coverage has shown: `seconds` that those which passed took, and what they ran."""

    def __init__(self, root: Path) -> None:
        from coverage import CoverageData

        self.root, self._folder = root, root / RECORD
        notes = [json.loads(line) for line in (self._folder / "times").read_text(encoding="utf-8").splitlines()]
        failed = {test for test, *took in notes if not took}
        self.seconds: dict[str, float] = {test: took[0] for test, *took in notes if test not in failed}
        self._data = CoverageData(str(self._folder / "data"))
        self._data.read()
        self._paths = {path[path.rindex(PACKAGE) :]: path for path in self._data.measured_files()}

    def running(self, file: str, lines: Iterable[int]) -> set[str]:
        """Return the tests that run any of some lines of a file. One that is new counts as the line above it."""
        old, ran = self._lines(file)
        known = (next((old[above] for above in range(line, 0, -1) if above in old), 0) for line in lines)
        return {test for line in known for test in ran.get(line, ()) if test in self.seconds}

    def ways(self, file: str) -> dict[str, frozenset[int]]:
        """Return the lines of a file that each test runs."""
        found: dict[str, set[int]] = defaultdict(set)
        for line, tests in self._lines(file)[1].items():
            for test in tests:
                found[test].add(line)
        return {test: frozenset(lines) for test, lines in found.items()}

    @functools.cache  # noqa: B019 - there is one record
    def _lines(self, file: str) -> tuple[dict[int, int], dict[int, set[str]]]:
        """Return the numbers that lines had then, and the tests by those numbers."""
        if file not in self._paths:
            return {}, {}
        then = (self._folder / file).read_text("utf-8").splitlines()
        now = (self.root / file).read_text("utf-8").splitlines()
        blocks = difflib.SequenceMatcher(None, then, now, autojunk=False).get_matching_blocks()
        old = {block.b + n + 1: block.a + n + 1 for block in blocks for n in range(block.size)}
        ran = self._data.contexts_by_lineno(self._paths[file])
        return old, {line: {re.sub(r" \(\w+\)$", "", test) for test in tests} for line, tests in ran.items()}


def covering(mutant: Mutant, known: Record) -> set[str]:
    """Return the tests that run a mutant's line; of one that runs on import, those that run what it is part of.

    These run its function or class, or lines with their names, or otherwise any line of its file.
    """
    around = mutant.around
    if not mutant.on_import:
        line = mutant.line
        return known.running(mutant.file, [line]) or known.running(mutant.file, range(around[-1].lineno, line))
    named = [node for node in around if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)]
    names = {node.name for node in named} or {node.id for node in ast.walk(around[0]) if isinstance(node, ast.Name)}
    found = naming(names, known)
    for node in named[-1:]:
        found |= known.running(mutant.file, range(node.lineno, (node.end_lineno or 0) + 1))
    # Of a field or a constant first of all those that use it, if any, of which there are fewer, or speak of its class.
    targets = getattr(around[-1], "targets", [getattr(around[-1], "target", None)])
    using = naming({node.id for node in targets if isinstance(node, ast.Name)}, known)
    found = (found & using or using or found) | {test for test in found if names & said_by(known.root, test)}
    return found or known.running(mutant.file, range(1, mutant.old.count("\n") + 1))


def naming(names: Iterable[str], known: Record) -> set[str]:
    """Return the tests that run lines with any of some names."""
    word = re.compile(rf"\b({'|'.join(names)})\b")
    found: set[str] = set()
    for file in sources(known.root) if word.pattern != r"\b()\b" else ():
        text = (known.root / file).read_text("utf-8").splitlines()
        found |= known.running(file, [number for number, words in enumerate(text, 1) if word.search(words)])
    return found


def in_order(tests: Iterable[str], seconds: Mapping[str, float], ways: Mapping[str, object], limit: float) -> list[str]:
    """Return tests in the order in which to run them, as many as take no more than a limit together, or one.

    The quickest of each way through the file comes before the second of any; cases of one function come last.
    """
    ordered = sorted(tests, key=lambda test: (seconds[test], test))
    for group in (lambda test: test.partition("[")[0], ways.get):
        before: Counter[object] = Counter()
        rank: dict[str, int] = {}
        for test in ordered:
            rank[test] = before[group(test)]
            before[group(test)] += 1
        ordered.sort(key=rank.__getitem__)
    return within(ordered, seconds, limit) or ordered[:1]


def within(tests: Sequence[str], seconds: Mapping[str, float], limit: float) -> list[str]:
    """Return the first tests, as many as take no more than a limit together."""
    spent = itertools.accumulate(seconds[test] for test in tests)
    return list(tests[: sum(total <= limit for total in spent)])


def speaking(root: Path, tests: Iterable[str], words: set[str], seconds: Mapping[str, float]) -> list[str]:
    """Return the tests whose own text has any of some words, those with the rarest first; the quickest case of each."""
    quickest = {test.partition("[")[0]: test for test in sorted(tests, key=lambda test: (-seconds[test], test))}
    said = {name: words & said_by(root, name) for name in quickest}
    common = Counter(word for found in said.values() for word in found)
    weight = {name: sum(1 / common[word] for word in found) for name, found in said.items()}
    return [quickest[name] for name in sorted(weight, key=lambda name: (-weight[name], name)) if weight[name]]


def said_by(root: Path, test: str) -> set[str]:
    """Return the words of a test's own text."""
    path, *_, function = test.partition("[")[0].split("::")
    return _vocabularies(root / path).get(function, set())


@functools.cache
def _vocabularies(file: Path) -> dict[str, set[str]]:
    """Return the words of each function in a file with tests."""
    text = file.read_text("utf-8") if file.suffix == ".py" and file.is_file() else ""
    nodes = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))
    lines = text.splitlines()
    return {node.name: set(WORD.findall("\n".join(lines[node.lineno - 1 : node.end_lineno]))) for node in nodes}


def chosen(root: Path, mutant: Mutant, tests: set[str], known: Record, limit: float) -> list[str]:
    """Return the tests that are most likely to notice a mutant, in the order in which to run them."""
    first = within(speaking(root, tests, mutant.words, known.seconds), known.seconds, limit / 2)
    left = limit - sum(known.seconds[test] for test in first)
    rest = tests.difference(first)
    return first + (in_order(rest, known.seconds, known.ways(mutant.file), left) if rest else [])


@dataclass
class Mutant:
    """A changed place in a file, whose text was `old` and is `new`."""

    file: str
    line: int
    old: str
    new: str
    tests: list[str] = field(default_factory=list)  # that may notice, in the order in which to run them
    covering: int = 0  # how many those would be without a limit
    outcome: str = ""  # caught, hangs, types, survives, no test or equivalent

    @property
    def package(self) -> str:
        """The package of the file, without `urlab_client`."""
        return "".join(Path(self.file).relative_to(PACKAGE).parts[:-1][:1]) or "(top)"

    @property
    def around(self) -> list[ast.stmt]:
        """The statements that it is in, from the outside inwards."""
        statements = (node for node in ast.walk(ast.parse(self.old)) if isinstance(node, ast.stmt))
        return [node for node in statements if node.lineno <= self.line <= (node.end_lineno or 0)]

    @property
    def words(self) -> set[str]:
        """The words of the lines that change, and the names of the functions and classes that they are in."""
        names = {getattr(node, "name", "") for node in self.around}
        return names.union(WORD.findall(self.changed("-")), WORD.findall(self.changed("+")))

    @property
    def on_import(self) -> bool:
        """Whether it runs when the module is imported: it is in the body of no function."""
        functions = [node for node in self.around if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
        return not functions or self.line < functions[-1].body[0].lineno

    @property
    def diff(self) -> list[str]:
        """The lines that are changed, two around them, and their place."""
        return list(difflib.unified_diff(self.old.splitlines(), self.new.splitlines(), lineterm="", n=2))[2:]

    def changed(self, sign: str) -> str:
        """Return what is removed (`-`) or added (`+`), without its indentation."""
        return "\n".join(line[1:].strip() for line in self.diff if line.startswith(sign))


def sources(root: Path) -> list[str]:
    """Return the files that people write."""
    texts = {path: path.read_text("utf-8") for path in sorted((root / PACKAGE).rglob("*.py")) if path.stem != "windows"}
    return [path.relative_to(root).as_posix() for path, text in texts.items() if not text.startswith("# Generated by")]


def places(code: str) -> dict[int, list[list[Callable[[], str]]]]:
    """Return for each line of a module, for each place on it that mutates, functions that make the changed text."""
    import libcst as cst
    import libcst.matchers as m
    from libcst.metadata import MetadataWrapper, PositionProvider
    from mutmut.mutation import mutators

    def deleted(node: cst.Expr) -> Iterator[cst.CSTNode]:
        if isinstance(node.value, cst.Call | cst.Await):
            yield cst.Pass()  # mutmut deletes no statements

    prose = {mutators.operator_string, mutators.operator_dict_arguments}
    operators: list[tuple[type, Callable[[Any], Iterable[cst.CSTNode]]]] = [(cst.Expr, deleted)]
    operators += [(kind, operator) for kind, operator in mutators.mutation_operators if operator not in prose]
    found: dict[int, list[list[Callable[[], str]]]] = defaultdict(list)
    wrapper = MetadataWrapper(cst.parse_module(code))
    replaced: Any = wrapper.module.deep_replace

    # What only type checkers see, the log, other systems, and what everything would trip over.
    untouched = (
        (m.Annotation() | m.Decorator() | m.Import() | m.ImportFrom())
        | m.Call(func=m.Name("len") | m.Name("isinstance") | m.Name("cast"))
        | m.Expr(value=m.Call(func=m.Attribute(value=m.Name("logger") | m.Name("log") | m.Name("_log"))))
        | m.If(test=m.Name("TYPE_CHECKING") | m.Comparison(left=m.Attribute(value=m.Name("sys"))))
        | m.Assign(targets=[m.AssignTarget(target=m.Name("__all__"))])
        | m.Assign(value=m.Call(func=m.Name("TypeVar") | m.Name("TypeVarTuple") | m.Name("ParamSpec")))
        | m.AnnAssign(annotation=m.Annotation(annotation=m.Name("TypeAlias")))
    )

    class Places(cst.CSTVisitor):
        METADATA_DEPENDENCIES = (PositionProvider,)

        def on_visit(self, node: cst.CSTNode) -> bool:
            if m.matches(node, untouched):
                return False
            made = [new for kind, operator in operators if isinstance(node, kind) for new in operator(node)]
            if made:
                line: int = self.get_metadata(PositionProvider, node).start.line  # pyright: ignore[reportAttributeAccessIssue]
                found[line].append([lambda new=new: replaced(node, new).code for new in made])
            return True

    wrapper.visit(Places())
    return found


def draw(root: Path, count: int, seed: str) -> list[Mutant]:
    """Return mutants at as many lines, drawn evenly from those that have any."""
    chance = random.Random(seed)  # noqa: S311 - a sample that can be drawn again
    texts = {file: (root / file).read_text("utf-8") for file in sources(root)}
    lines = [(file, line) for file, text in texts.items() for line in range(1, text.count("\n") + 1)]
    chance.shuffle(lines)
    parsed = functools.cache(lambda file: places(texts[file]))
    found = ((file, line, parsed(file).get(line)) for file, line in lines)
    drawn = itertools.islice(((file, line, here) for file, line, here in found if here), count)
    return [Mutant(file, line, texts[file], chance.choice(chance.choice(here))()) for file, line, here in drawn]


def run(tree: Path, tests: Sequence[str]) -> tuple[int | None, str, list[str]]:
    """Run tests on a tree until one fails; return pytest's exit code (None if it hangs), output and failures."""
    with tempfile.TemporaryDirectory(dir=tree.parent) as name:
        chosen, caught, said = (Path(name) / file for file in ("tests", "caught", "said"))
        chosen.write_text("\n".join(tests), encoding="utf-8")
        options = ["-q", "-x", "-n0", "-m", "", f"--timeout={TEST_S}", "-p", "no:cacheprovider", "-p", "sample_mutants"]
        command = [sys.executable, "-m", "pytest", *options, f"@{chosen}"]
        environment = {**os.environ, "PYTHONPATH": f"{tree}/src:{tree}/tools", "TMPDIR": name, CAUGHT_BY: str(caught)}
        with said.open("wb") as output:
            streams = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT}
            process = subprocess.Popen(command, cwd=tree, env=environment, start_new_session=True, **streams)  # noqa: S603
            code = None
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = process.wait(RUN_S)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # with all that it has left running
            process.wait()
        failed = [json.loads(line)[0] for line in caught.read_text().splitlines()] if caught.exists() else []
        return code, said.read_text(errors="replace"), failed


class Copies:
    """Copies of a tree: one for each mutant that is judged at a time, and one that stays as it is."""

    def __init__(self, root: Path, folder: Path, count: int) -> None:
        listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(listing, cwd=root, capture_output=True, check=True, text=True).stdout  # noqa: S603
        self._sound, *others = [folder / str(number) for number in range(count + 1)]
        self._free: queue.SimpleQueue[Path] = queue.SimpleQueue()
        self._moments = itertools.count(int(time.time()))
        for name in filter(lambda name: (root / name).is_file(), names.split("\0")):
            (self._sound / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, self._sound / name)
        for tree in others:
            shutil.copytree(self._sound, tree)
            self._free.put(tree)

    def judge(self, mutant: Mutant) -> Mutant:
        """Run a mutant's tests, and note the outcome."""
        tree = self._free.get()
        self._write(tree / mutant.file, mutant.new)
        while mutant.tests and not mutant.outcome:
            code, output, failed = run(tree, mutant.tests)
            gone = {test for test in mutant.tests if f"not found: {tree / test}\n" in output}
            if unsound := gone | {test for test in failed if run(self._sound, [test])[0] != PASSED}:
                kept = [test for test in mutant.tests if test not in unsound]
                mutant.tests = kept if len(kept) < len(mutant.tests) else []
            else:
                passed = "survives" if mutant.covering else "no test"
                mutant.outcome = {None: "hangs", PASSED: passed}.get(code, "caught")
        mutant.outcome = mutant.outcome or "no test"
        self._write(tree / mutant.file, mutant.old)
        self._free.put(tree)
        return mutant

    def _write(self, file: Path, text: str) -> None:
        file.write_text(text, encoding="utf-8")
        moment = next(self._moments)
        os.utime(file, (moment, moment))  # or bytecode of the same second would pass for its own


def judge_types(root: Path, tree: Path, mutants: Sequence[Mutant]) -> None:
    """Note which mutants pyright reports: each is a module beside its own, whose reports do not count."""
    if not mutants or find_spec("pyright") is None:
        return
    for name in ("src", "typings"):
        if (root / name).is_dir():
            shutil.copytree(root / name, tree / name)
    files: dict[Path, Path] = {}  # the one with the mutant, and the one without
    for number, mutant in enumerate(mutants):
        path = tree / mutant.file
        sound, changed = path.with_stem(f"{path.stem}__sound"), path.with_stem(f"{path.stem}__{number}")
        sound.write_text(mutant.old, encoding="utf-8")
        changed.write_text(mutant.new, encoding="utf-8")
        files[changed] = sound
    settings = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["tool"]["pyright"]
    settings["include"] = sorted({str(file.relative_to(tree)) for pair in files.items() for file in pair})
    (tree / "pyrightconfig.json").write_text(json.dumps(settings), encoding="utf-8")
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable, "-p", str(tree)]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=False)  # noqa: S603
    if done.returncode not in {0, 1}:  # the tests' answers, which took long, are told all the same
        print(f"pyright failed, so no types were checked: {done.stderr or done.stdout}", file=sys.stderr)
        return
    reported: dict[Path, Counter[tuple[str, str]]] = defaultdict(Counter)
    for one in json.loads(done.stdout)["generalDiagnostics"]:
        if one["severity"] == "error":
            reported[Path(one["file"])][one.get("rule", ""), re.sub(r"__(sound|\d+)", "", one["message"])] += 1
    for mutant, (changed, sound) in zip(mutants, files.items(), strict=True):
        if reported[changed] - reported[sound]:
            mutant.outcome = "types"


def shares(mutants: Sequence[Mutant]) -> Iterator[str]:
    """Yield a row for each package, and one for all: caught by tests, by the type checker, of how many."""
    for name in [*sorted({mutant.package for mutant in mutants}), "all"]:
        outcomes = Counter(mutant.outcome for mutant in mutants if name in {mutant.package, "all"})
        tests, types = outcomes["caught"] + outcomes["hangs"], outcomes["types"]
        judged = outcomes.total() - outcomes["equivalent"]
        yield f"{name:14} {tests:4} + {types:3} of {judged:4}  {(tests + types) / judged if judged else 1:4.0%}"


def main(argv: Sequence[str] | None = None, *, root: Path = ROOT, table: Path = EQUIVALENT) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=100, help="mutants to draw (default: %(default)s)")
    parser.add_argument("--seed", default=str(time.time_ns()), help="what determines them (default: the time)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of tests for each (default: %(default)g)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="judged side by side (default: %(default)s)")
    parser.add_argument("--record", action="store_true", help="run tests under coverage, and draw nothing")
    parser.add_argument("--only", default="", metavar="FILE:LINE", help="judge those of the sample at this place")
    parser.add_argument("tests", nargs="*", help="pytest's arguments (default: all tests, or those in the record)")
    arguments = parser.parse_args(argv)
    if arguments.record:
        record(root, arguments.tests)
        return 0
    known = Record(root)
    entries = tomllib.loads(table.read_text(encoding="utf-8")).get("mutant", [])
    equivalent = {(entry["old"].strip(), entry["new"].strip()) for entry in entries}
    sample = draw(root, arguments.n, arguments.seed)
    drawn = [mutant for mutant in sample if f"{mutant.file}:{mutant.line}".endswith(arguments.only)]
    print(f"{len(drawn)} mutants, seed {arguments.seed}", flush=True)
    for mutant in drawn:
        if (mutant.changed("-"), mutant.changed("+")) in equivalent:
            mutant.outcome = "equivalent"
        mutant.covering = len(tests := covering(mutant, known))
        # Confined processes can write no record of what they run: any test that runs the rest of the file may notice.
        tests = tests or known.running(mutant.file, range(1, mutant.old.count("\n") + 1))
        declared = [test for test in DECLARED if mutant.on_import and (root / test.partition("::")[0]).is_file()]
        mutant.tests = list(arguments.tests) or declared + chosen(root, mutant, tests, known, arguments.seconds)
    with tempfile.TemporaryDirectory(prefix="m") as folder, ThreadPoolExecutor(arguments.jobs) as pool:
        copies = Copies(root, Path(folder), arguments.jobs)
        for mutant in pool.map(copies.judge, drawn):
            print(f"{mutant.outcome:10} {mutant.file}:{mutant.line}", flush=True)
        judge_types(root, Path(folder) / "types", [one for one in drawn if one.outcome in {"survives", "no test"}])
    for mutant in drawn:
        if mutant.outcome in {"survives", "no test"}:
            ran = f"{len(mutant.tests)} of the {mutant.covering} tests that run it passed"
            ran = ran if mutant.covering else "no test is known to run it"
            print(f"\n{mutant.outcome}: {mutant.file}:{mutant.line} ({ran})", *mutant.diff, sep="\n")
    print("", *shares(drawn), sep="\n")
    print(f"{sum(os.times()[2:4]) / max(1, len(drawn)):.1f} s of the processors for each")
    return 0


if __name__ == "__main__":
    sys.exit(main())
