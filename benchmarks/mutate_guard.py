"""Deletes every single statement of the guard and of the stop sequence in turn: each deletion must make a test fail.

    python benchmarks/mutate_guard.py                 # all of it; 1 if a deletion survives
    python benchmarks/mutate_guard.py --branches      # which branches of them the same tests leave out; 1 if any
    python benchmarks/mutate_guard.py guard --jobs 2

Works on copies in memory: a child process per mutant is forked off this one, loads the changed module in the place of
the real one, and runs the module's tests up to the first failure. Nothing in the checkout is written.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.util
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TESTS = ROOT / "tests" / "protocol"
_STOP = (
    "test_stop.py", "test_stop_feedback.py", "test_stop_interrupted.py", "test_stop_patience.py",
    "test_stop_torque_off.py", "test_stop_in_between.py", "test_stop_string.py", "test_stop_looks.py",
)
SUBJECTS = {
    "guard": ("test_guard.py", "test_guard_prediction.py"),
    "stop": _STOP,
    "let_go": _STOP,
    "stop_patience": _STOP,
    "stop_looks": ("test_stop_looks.py",),
    "string_rules": _STOP,
}
LONGEST_S = 90
"""A mutant that loops for ever counts as found."""

_FALLS_THROUGH = "the function's last line: what falls off its end gives None, which its only caller takes alike"
EQUIVALENT = {
    "stop.py, _slow_down: return False (last)": _FALLS_THROUGH,
    "stop.py, _see_rest: return None (last)": _FALLS_THROUGH,
    "stop.py, _gets_slower: return False (last)": _FALLS_THROUGH,
    "stop_looks.py, __init__: self._speed_rad_s = math.inf (last)": "what is seen first sets it in any case",
    "let_go.py, _yielding: assert self._reference_nm is not None": "says to mypy what the only caller has just set",
}
"""Deletions that change nothing that can be seen, and why. (mypy refuses them all the same.)"""


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds one module: the changed one."""

    def __init__(self, name: str, tree: ast.Module, path: Path) -> None:
        self.name = name
        self.code = compile(tree, str(path), "exec")
        self.extra: dict[str, object] = {}

    def find_spec(self, fullname, path=None, target=None):
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.name else None

    def exec_module(self, module) -> None:
        vars(module).update(self.extra)
        exec(self.code, vars(module))


def path_of(subject: str) -> Path:
    return ROOT / "tdhil" / "protocol" / f"{subject}.py"


def is_text(statement: ast.stmt) -> bool:
    """A docstring, of a module, a class, a function or a constant."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def deletable(tree: ast.Module) -> list[tuple[list[ast.stmt], int]]:
    """(the list that a statement stands in, its place); imports, texts and whole definitions are left alone."""
    found = []
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if not isinstance(block, list):
                continue
            for place, statement in enumerate(block):
                kept = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef, ast.Pass)
                annotation = isinstance(statement, ast.AnnAssign) and statement.value is None
                if not isinstance(statement, kept) and not is_text(statement) and not annotation:
                    found.append((block, place))
    return found


def mutants(subject: str):
    """(line, what and where in words, tree without that statement), one by one."""
    text = path_of(subject).read_text("utf-8")
    for number in range(len(deletable(ast.parse(text)))):
        tree = ast.parse(text)
        block, place = deletable(tree)[number]
        gone = block[place]
        within = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and gone in ast.walk(node)]
        name = within[-1].name if within else "module"
        last = " (last)" if within and within[-1].body[-1] is gone else ""
        block[place] = ast.copy_location(ast.Pass(), gone)
        yield gone.lineno, f"{name}: {ast.unparse(gone).splitlines()[0]}{last}", ast.fix_missing_locations(tree)


class Counted(ast.NodeTransformer):
    """Every test of an if, while, conditional expression or comprehension says which way it went; loops likewise."""

    def __init__(self) -> None:
        self.places: list[tuple[int, str]] = []

    def note(self, node: ast.expr, text: str) -> ast.expr:
        self.places.append((node.lineno, text))
        call = ast.Call(ast.Name("_went", ast.Load()), [ast.Constant(len(self.places) - 1), node], [])
        return ast.copy_location(call, node)

    def visit_If(self, node):
        self.generic_visit(node)
        node.test = self.note(node.test, "if " + ast.unparse(node.test))
        return node

    visit_While = visit_If

    def visit_IfExp(self, node):
        self.generic_visit(node)
        node.test = self.note(node.test, "if " + ast.unparse(node.test))
        return node

    def visit_For(self, node):
        self.generic_visit(node)
        self.places.append((node.lineno, "for " + ast.unparse(node.target)))
        number = len(self.places) - 1
        # Gone through to the end (False), or entered (True).
        for block, way in ((node.body, True), (node.orelse, False)):
            call = ast.Call(ast.Name("_went", ast.Load()), [ast.Constant(number), ast.Constant(way)], [])
            block.insert(0, ast.copy_location(ast.Expr(call), node))
        return node


def run_tests(subject: str, changed: Changed) -> int:
    """In this very process: pytest's exit code."""
    import pytest

    sys.meta_path.insert(0, changed)
    quiet = ["-q", "-x", "-p", "no:cacheprovider", "--no-header", "--hypothesis-seed=0", "-o", "addopts="]
    return int(pytest.main([*quiet, "--import-mode=importlib", *(str(TESTS / name) for name in SUBJECTS[subject])]))


def preload() -> None:
    """What every child needs and no mutant changes."""
    sys.path[:0] = [str(ROOT)]
    import hypothesis
    import numpy
    import pytest
    import scipy.optimize

    import drivers.drive
    import tdhil.errors
    import tdhil.identify
    import tdhil.protocol.design
    import tdhil.protocol.excitation
    import tdhil.record.run_log

    assert all((hypothesis, numpy, pytest, scipy.optimize, drivers.drive, tdhil.errors, tdhil.identify,
                tdhil.protocol.design, tdhil.protocol.excitation, tdhil.record.run_log))
    loaded = [name for name in SUBJECTS if f"tdhil.protocol.{name}" in sys.modules]
    assert not loaded, loaded


def fork(subject: str, changed: Changed, report: Path | None = None) -> int:
    """The child's process number."""
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        signal.alarm(LONGEST_S)
        folder = tempfile.mkdtemp(prefix="mutate-")
        os.chdir(folder)
        hush = os.open(os.devnull if report is None else str(report) + ".log", os.O_WRONLY | os.O_CREAT)
        os.dup2(hush, 1)
        os.dup2(hush, 2)
        went: set[tuple[int, bool]] = set()

        def note(number, value):
            went.add((number, bool(value)))
            return value

        changed.extra["_went"] = note
        code = run_tests(subject, changed)
        if report is not None:
            report.write_text(json.dumps(sorted(went)))
    finally:
        os._exit(code)


def delete_all(subject: str, jobs: int) -> list[str]:
    """The deletions that no test noticed."""
    name = f"tdhil.protocol.{subject}"
    running: dict[int, tuple[int, str]] = {}
    survivors: list[str] = []
    count = alike = 0

    def reap() -> None:
        nonlocal alike
        child, status = os.wait()
        line, text = running.pop(child)
        if os.waitstatus_to_exitcode(status) != 0:
            return
        if text in EQUIVALENT:
            alike += 1
        else:
            survivors.append(f"line {line}, {text}")
            print(f"SURVIVES {survivors[-1]}", flush=True)

    for line, text, tree in mutants(subject):
        count += 1
        while len(running) >= jobs:
            reap()
        running[fork(subject, Changed(name, tree, path_of(subject)))] = line, f"{subject}.py, {text}"
    while running:
        reap()
    noticed = count - alike - len(survivors)
    print(f"{subject}.py: {count} deletions, {noticed} noticed, {alike} alike, {len(survivors)} survive", flush=True)
    return survivors


def branches(subject: str) -> list[str]:
    """The ways that no test takes."""
    tree = ast.parse(path_of(subject).read_text("utf-8"))
    counted = Counted()
    tree = ast.fix_missing_locations(counted.visit(tree))
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "went.json"
        _, status = os.waitpid(fork(subject, Changed(f"tdhil.protocol.{subject}", tree, path_of(subject)), report), 0)
        if os.waitstatus_to_exitcode(status) != 0:
            print(Path(str(report) + ".log").read_text()[-3000:])
            return [f"{subject}.py: its tests fail"]
        went = {(number, way) for number, way in json.loads(report.read_text())}
    wanted = {(number, way) for number in range(len(counted.places)) for way in (True, False)}
    missing = sorted(wanted - went)
    share = 100.0 * (1.0 - len(missing) / max(1, len(wanted)))
    print(f"{subject}.py: {len(wanted)} branches, {len(missing)} not taken, {share:.1f} %", flush=True)
    return [f"{subject}.py:{counted.places[number][0]}: {counted.places[number][1]} is never {way}"
            for number, way in missing]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("subjects", nargs="*", help=f"{', '.join(SUBJECTS)} (default: all)")
    parser.add_argument("--branches", action="store_true", help="branch coverage instead")
    parser.add_argument("--jobs", type=int, default=1)
    wanted = parser.parse_args()
    begun_s = time.monotonic()
    preload()
    left: list[str] = []
    for subject in wanted.subjects or SUBJECTS:
        left += branches(subject) if wanted.branches else delete_all(subject, wanted.jobs)
    for line in left:
        print(line)
    print(f"{time.monotonic() - begun_s:.0f} s")
    return 1 if left else 0


if __name__ == "__main__":
    sys.exit(main())
