"""Do the tests notice a flipped sign? Draws mutants of the methods and scores at random and runs the tests of their area.

    python benchmarks/mutants.py --seed 1 [--count 100] [--work runs/mutants] [--survivors]

A mutant is one change of a syntax tree: an arithmetic operator becomes its inverse, a comparison its negation, `and` is
`or`, a negation or a minus sign goes, a number gets the other sign, True is False, a condition is its opposite. Numbers
that say along which axis, annotations, decorators and messages of errors are left alone. At most a third of the mutants are
drawn in files that numba compiles, since each of those is compiled anew.

The tests are those that name the changed module or the methods it registers, the conformance of these, and those of its
folder (`AREAS`), the particular ones first; the one that fails with a change passes without. A test that takes long is
skipped, so a survivor may be one of those that a slow test would kill. Functions are changed in a running process first, so
that most mutants cost seconds; what lives through that, and what numba compiles, is run from files. The sources are copied
to the work folder and stay as they were drawn; the tests are those of the checkout at each start. A run that was killed goes
on; `--survivors` runs those again that no test killed, for tests written since.
"""

import argparse
import ast
import copy
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import types
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from fdi_gym.diagnosis import diagnosers
from fdi_gym.files import write_whole
from fdi_gym.tables import markdown

ROOT = Path(__file__).parent.parent
SLOW, LIMIT = 15.0, 200.0  # core-seconds after which a test is skipped, and after which the tests of a file have failed
MUTATED = [
    "fdi_gym/estimation", "fdi_gym/diagnosis", "baselines/filters", "baselines/learned",
    *(f"fdi_gym/{name}.py" for name in ("metrics", "scores", "intervals", "declaration", "tasks")),
]  # fmt: skip
AREAS = {  # what tests a folder as a whole, beside the tests that name a file
    "fdi_gym/estimation": ["gaussian", "general_filters", "general_methods"],
    "fdi_gym/diagnosis": ["guard", "shells", "knowledge", "conformance"],
    "baselines/filters": ["general_methods"],
    "baselines/learned": ["learned", "reinforcement"],
    "fdi_gym": ["metrics", "evaluation", "suites"],
}
ELSEWHERE = {"cli", "rows", "fuzz_rows", "interrupted", "readme", "sb3", "reproduction", "grid", "engine", "scenarios"}
FLIPPED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


FORKS = """
import gc, importlib, json, os, signal, sys, types
for name in ("gymnasium", "hypothesis", "joblib", "msgspec", "numba", "pytest", "scipy.linalg", "scipy.special",
             "scipy.stats", "stable_baselines3", "torch", "tqdm", "tyro"):
    importlib.import_module(name)
import pytest

def codes(code):
    yield code
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from codes(part)

def change(before, after):
    pairs = list(zip(*(codes(compile(open(file).read(), before, "exec")) for file in (before, after)), strict=True))
    into = {old: new for old, new in pairs if old != new}
    for function in gc.get_objects():
        if isinstance(function, types.FunctionType) and function.__code__ in into:
            function.__code__ = into[function.__code__]

class Capped:
    def __init__(self, most):
        self.most = most

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        signal.signal(signal.SIGPROF, lambda *_: pytest.skip("slow"))
        signal.setitimer(signal.ITIMER_PROF, self.most)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

for line in sys.stdin:
    how, limit, most, arguments, files = json.loads(line)
    child = 0 if how == "here" else os.fork()
    if not child:
        kept = os.dup(1)
        said = os.open(sys.argv[1], os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(said, 1)
        os.dup2(said, 2)
        if how != "here":
            signal.signal(signal.SIGVTALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_VIRTUAL, limit)
        if files:
            change(*files)
        status = pytest.main(arguments, [Capped(most)])
        sys.stdout.flush()
        if how != "here":
            os._exit(status)
        os.dup2(kept, 1)
    else:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    print(int(status), flush=True)
"""


class Mutant(msgspec.Struct):
    """One change of one file, and what became of it."""

    file: str
    line: int
    before: str
    after: str
    start: int  # of the text that changes, in bytes
    stop: int
    tests: list[str] = []
    lived: bool = False  # in the running process
    killed: bool | None = None  # None: not run yet
    by: str = ""
    seconds: float = 0.0


class _Change(NamedTuple):
    node: ast.AST
    into: ast.AST


def changes(node: ast.AST) -> Iterator[_Change]:
    """All changes of a tree that may alter what it computes."""
    match node:
        case ast.Raise() | ast.JoinedStr() | ast.ImportFrom() | ast.Import():
            return
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in FLIPPED:
            yield _Change(node, _with(node, op=FLIPPED[type(op)]()))
        case ast.Compare(ops=ops):
            for i, op in enumerate(ops):
                yield _Change(node, _with(node, ops=[*ops[:i], FLIPPED[type(op)](), *ops[i + 1 :]]))
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert()):
            yield _Change(node, node.operand)
            if isinstance(node.operand, ast.Constant):
                return
        case ast.Constant(value=bool(value)):
            yield _Change(node, ast.Constant(not value))
        case ast.Constant(value=int(value) | float(value)) if value:
            yield _Change(node, ast.UnaryOp(ast.USub(), node))
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test) if not isinstance(
            test, (ast.Compare, ast.UnaryOp)
        ):
            yield _Change(test, ast.UnaryOp(ast.Not(), test))
    for name, field in ast.iter_fields(node):
        skipped = name in ("annotation", "returns", "decorator_list", "type_params") or (
            isinstance(node, ast.keyword) and node.arg in ("axis", "axes", "ndim")
        )
        for child in field if isinstance(field, list) else [field]:
            if isinstance(child, ast.AST) and not skipped:
                yield from changes(child)


def _with(node, **fields):
    found = copy.copy(node)
    for name, value in fields.items():
        setattr(found, name, value)
    return found


def of_source(file: str, source: bytes) -> list[Mutant]:
    """All mutants of a source text."""
    starts = np.cumsum([0, *(len(line) for line in source.splitlines(keepends=True))])
    found = []
    for node, into in changes(ast.parse(source)):
        place: Any = node
        start, stop = starts[place.lineno - 1] + place.col_offset, starts[place.end_lineno - 1] + place.end_col_offset
        after = ast.unparse(into)
        if isinstance(node, ast.expr):
            after = f"({after})"
        found.append(Mutant(file, place.lineno, source[start:stop].decode(), after, int(start), int(stop)))
    return found


def tests_of(file: str) -> list[str]:
    """The tests of a source file's area: the files that name it or what it registers, conformance, and its folder's."""
    text = (ROOT / file).read_text()
    names = re.findall(r'@(?:diagnoser|trainer)\(\s*"(\w+)"', text)
    module, words = file.removesuffix(".py").replace("/", "."), "|".join([*names, Path(file).stem])
    named = re.compile(rf'\b{re.escape(module)}\b|import [^\n]*\b{Path(file).stem}\b|"({words})\b')
    area = next(tests for folder, tests in AREAS.items() if file.startswith(folder))
    naming = [path.stem.removeprefix("test_") for path in sorted((ROOT / "tests").glob("test_*.py"))
              if named.search(path.read_text())]  # fmt: skip
    files = [f"tests/test_{name}.py" for name in dict.fromkeys([*naming, *area]) if name not in {*ELSEWHERE, "conformance"}]
    methods = sorted({*names} & {*diagnosers()}) or (["augmented_ekf"] if "conformance" in area else [])
    same = f"tests/test_conformance.py -k test_diagnoser and ({' or '.join(f'{name}-' for name in methods)})"
    return [*files, same] if methods else files


def is_compiled(path: Path) -> bool:
    """Whether numba compiles what a file holds."""
    return bool(re.search(r"@(compiled|helper|numba\.njit)", path.read_text()))


def draw(seed: int, count: int) -> list[Mutant]:
    """So many mutants at random, at most a third of them in compiled files."""
    files = [
        str(path.relative_to(ROOT)) for place in MUTATED
        for path in ([ROOT / place] if place.endswith(".py") else sorted((ROOT / place).glob("*.py")))
    ]  # fmt: skip
    every = [mutant for file in files for mutant in of_source(file, (ROOT / file).read_bytes())]
    compiled = {file for file in files if is_compiled(ROOT / file)}
    found, dear = [], 0
    for i in np.random.default_rng(seed).permutation(len(every)):
        if len(found) == count:
            break
        if every[i].file in compiled:
            if 3 * (dear + 1) > count:
                continue
            dear += 1
        found.append(every[i])
    areas = {file: tests_of(file) for file in files}
    common = Counter(tests for area in areas.values() for tests in area)
    for mutant in found:
        mutant.tests = sorted(areas[mutant.file], key=lambda tests: common[tests])  # those of few files first
    return sorted(found, key=lambda mutant: (mutant.file in compiled, "learned" in mutant.file))  # the dear ones last


class Tester:
    """Runs tests in the tree, each time in a fork of a process that has imported the libraries, and nothing of the tree.

    A live one has collected the tests before, so all is imported; a change of a function is then made in its memory. What it
    had computed with the unchanged code it keeps: that no test fails there says nothing.
    """

    def __init__(self, work: Path, live: bool):
        cache = work / "cache"
        environment = os.environ | {
            "PYTHONPATH": str(work / "tree"), "FDI_GYM_CACHE_DIR": str(cache), "PYTHONPYCACHEPREFIX": str(cache / "pyc"),
            "PYTHONDONTWRITEBYTECODE": "", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1",
        }  # fmt: skip
        self.work, self.said, self.live = work, work / f"said-{live}.txt", live
        self.collected: set[str] = set()
        self.passed: dict[str, bool] = {}
        command = [sys.executable, "-c", FORKS, str(self.said)]
        self.process: Any = subprocess.Popen(
            command, cwd=work / "tree", env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def _run(self, how: str, tests: str, files: Sequence[Path] = ()) -> str:
        """The first failure of tests that are not slow, in a fork; or, here, collect them only."""
        file, _, chosen = tests.partition(" -k ")
        arguments = ["-q", "--no-header", "--tb=no", "-p", "no:cacheprovider", "-p", "no:xdist", "-rfE",
                     *([file] if "::" in file else file.split()),
                     *(["-k", chosen] if chosen else []), "-x" if how == "fork" else "--collect-only"]  # fmt: skip
        request = [how, LIMIT, SLOW, arguments, [str(file) for file in files]]
        self.process.stdin.write(msgspec.json.encode(request).decode() + "\n")
        self.process.stdin.flush()
        status, said = int(self.process.stdout.readline()), self.said.read_text()
        if status in (0, 5):  # 5: there are none
            return ""
        failed = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - .*)?$", said, re.MULTILINE)
        return failed.group(1) if failed else "time" if status == -signal.SIGVTALRM else said.strip()[-300:] or "a crash"

    def passes(self, tests: str) -> bool:
        """Whether tests pass without a change, where they have been run with one."""
        if tests not in self.passed:
            self.passed[tests] = not self._run("fork", tests)
        return self.passed[tests]

    def first_failure(self, mutant: Mutant) -> str:
        """The first of a mutant's tests that fails with the change and passes without, or nothing."""
        drawn, path = self.work / "drawn" / mutant.file, self.work / "tree" / mutant.file
        source = drawn.read_bytes()
        after = source[: mutant.start] + mutant.after.encode() + source[mutant.stop :]
        changed = self.work / "changed.py"
        changed.write_bytes(after)
        if self.live and not of_functions(source, after):
            return ""
        for tests in mutant.tests:
            if self.live and tests not in self.collected:
                self._run("here", tests)
                self.collected.add(tests)
            try:
                if not self.live:
                    path.write_bytes(after)
                by = self._run("fork", tests, (path, changed) if self.live else ())
            finally:
                copy_file(drawn, path)
            if by and self.passes(by if by.startswith("tests/") else tests):
                return by
            if by:
                print(f"{by} fails without any change", flush=True)
        return ""


def of_functions(*sources: bytes) -> bool:
    """Whether two sources differ in functions alone; what modules do at first is done in a live process."""

    def codes(code: types.CodeType) -> Iterator[types.CodeType]:
        yield code
        for part in code.co_consts:
            if isinstance(part, types.CodeType):
                yield from codes(part)

    def own(code: types.CodeType) -> str:
        return repr((code.co_code, code.co_names, [c for c in code.co_consts if not isinstance(c, types.CodeType)]))

    pairs = zip(*(codes(compile(source, "", "exec")) for source in sources), strict=True)
    return all(old.co_flags & 1 for old, new in pairs if own(old) != own(new))


def copy_tree(tree: Path, only: str = ".") -> None:
    """Copy the files under version control, and new ones, to the work folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", only], cwd=ROOT, capture_output=True, check=True
    )
    for name in listed.stdout.decode().splitlines():
        if (ROOT / name).is_file():
            copy_file(ROOT / name, tree / name)


def copy_file(source: Path, target: Path) -> None:
    """Copy a file with its time, which numba's cache looks at."""
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(source, target)


def run(work: Path, seed: int, count: int, again: bool) -> list[Mutant]:
    """Draw mutants, or go on with those that are drawn, and write down after each what became of it."""
    tree, file = work / "tree", work / "mutants.json"
    if file.exists():
        mutants = msgspec.json.decode(file.read_bytes(), type=list[Mutant])
        copy_tree(tree, "tests")
        for mutant in mutants:  # one may have been left by a run that was killed
            copy_file(work / "drawn" / mutant.file, tree / mutant.file)
    else:
        copy_tree(tree)
        copy_tree(work / "drawn")
        mutants = draw(seed, count)
        write_whole(file, msgspec.json.encode(mutants))
    quick, sure = Tester(work, live=True), Tester(work, live=False)
    if again:
        for mutant in mutants:
            mutant.lived, mutant.killed = False, mutant.killed or None
    for tester in (quick, sure):
        for i, mutant in enumerate(mutants):
            compiled = is_compiled(work / "drawn" / mutant.file)
            if mutant.killed is not None or (tester is quick and (compiled or mutant.lived)):
                continue
            begun = time.monotonic()
            mutant.by = tester.first_failure(mutant)
            mutant.killed, mutant.lived = bool(mutant.by) or (None if tester is quick else False), not mutant.by
            mutant.seconds += time.monotonic() - begun
            write_whole(file, msgspec.json.encode(mutants))
            became = mutant.by or ("lives" if tester is quick else "SURVIVED")
            print(i, mutant.file, mutant.line, mutant.before[:60], "->", mutant.after[:60], became,
                  f"{mutant.seconds:.0f} s", flush=True)  # fmt: skip
    return mutants


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--work", type=Path, default=Path("runs/mutants"))
    parser.add_argument("--survivors", action="store_true")
    arguments = parser.parse_args()
    mutants = run(arguments.work.resolve(), arguments.seed, arguments.count, arguments.survivors)
    rows = [[f"{m.file}:{m.line}", f"`{' '.join(m.before.split())}`", f"`{m.after}`", m.by.rpartition("/")[2] or "nothing"]
            for m in mutants]  # fmt: skip
    print(markdown(["place", "before", "after", "killed by"], rows))
    print(f"{sum(bool(m.killed) for m in mutants)} of {len(mutants)} killed")


if __name__ == "__main__":
    main()
