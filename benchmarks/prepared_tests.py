"""Tests of one changed module, run many times from one process that has imported and collected them once.

`PreparedTests` forks a process that loads the module, collects its tests and waits. For each mutant it forks another
one, which replaces the code of the changed function in place and runs the tests that enter it. What a mutant costs is
then the time of these tests, without imports and collection. A statement of the module itself, or of a function that
is called while modules are loaded, can't be replaced so: `PreparedTests.replaceable` says it.
"""

from __future__ import annotations

import ast
import gc
import importlib.abc
import importlib.util
import json
import math
import os
import pickle
import signal
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

NOT_REPLACED = 77
"""Exit code of a child that could not replace the code of a function."""
TIMED_OUT = -int(signal.SIGKILL)


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds one module: the changed one."""

    def __init__(self, name: str, tree: ast.Module, path: Path) -> None:
        self.name = name
        self.path = path
        self.code = compile(tree, str(path), "exec")
        self.extra: dict[str, object] = {}

    def find_spec(self, fullname, path=None, target=None):
        return importlib.util.spec_from_loader(fullname, self) if fullname == self.name else None

    def exec_module(self, module) -> None:
        vars(module).update(self.extra, __file__=str(self.path))
        exec(self.code, vars(module))


def is_text(statement: ast.stmt) -> bool:
    """A docstring, of a module, a class, a function or a constant."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


class _Entered(ast.NodeTransformer):
    """Every function says that it was entered."""

    def visit_FunctionDef(self, node):
        self.generic_visit(node)
        call = ast.Call(ast.Name("_entered", ast.Load()), [ast.Constant(node.lineno)], [])
        node.body.insert(int(is_text(node.body[0])), ast.copy_location(ast.Expr(call), node.body[0]))
        return node


def marked(tree: ast.Module) -> ast.Module:
    """The tree, changed: each function first calls ``_entered`` with its line."""
    return ast.fix_missing_locations(_Entered().visit(tree))


@dataclass
class Trace:
    """How long each test takes, s; the tests that enter a function, by its line.

    What is entered outside of a test, or by what prepares one of a file, is entered by all of them.
    """

    took_s: dict[str, float]
    entered: dict[str, list[int]]

    def at_load(self, function: int) -> bool:
        """Was it entered while modules were loaded, or does the statement stand outside of functions (0)?"""
        return function == 0 or function in self.entered.get("", [])

    def tests(self, function: int) -> list[str]:
        """The tests for a mutant of this function, file by file, the quick ones first."""
        everywhere = self.at_load(function)
        chosen = [
            test for test in self.took_s if everywhere
            or function in self.entered.get(test, []) or function in self.entered.get(test.partition("::")[0], [])
        ]
        least: dict[str, float] = {}
        for test in chosen:
            file = test.partition("::")[0]
            least[file] = min(least.get(file, math.inf), self.took_s[test])
        return sorted(chosen, key=lambda test: (least[test.partition("::")[0]], test.partition("::")[0],
                                                self.took_s[test]))


class Watch:
    """Plugin of pytest that notes each test with its time and the functions that it enters."""

    def __init__(self, serve: Callable[[Any], None] | None = None) -> None:
        self._serve = serve
        self.now = ""
        self.took_s: dict[str, float] = {}
        self._lines: dict[str, set[int]] = {}

    def enter(self, line: int) -> None:
        self._lines.setdefault(self.now, set()).add(line)

    @property
    def entered(self) -> dict[str, list[int]]:
        return {name: sorted(lines) for name, lines in list(self._lines.items())}

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.now = nodeid.partition("::")[0]

    def pytest_runtest_logreport(self, report) -> None:
        self.took_s[report.nodeid] = self.took_s.get(report.nodeid, 0.0) + report.duration
        self.now = report.nodeid if report.when == "setup" else report.nodeid.partition("::")[0]

    def pytest_runtestloop(self, session):
        if self._serve is None:
            return None
        self._serve(session)
        return True


def run_items(session: Any, chosen: list[str] | None) -> int:
    """Run these tests of a session in their order (None: all). Return 1 if one failed, else 0."""
    from _pytest.main import pytest_runtestloop

    if chosen is not None:
        by_name = {item.nodeid: item for item in session.items}
        session.items[:] = [by_name[name] for name in chosen]
    try:
        pytest_runtestloop(session)
    except (session.Failed, session.Interrupted):
        return 1
    return int(session.testsfailed > 0)


def _codes_of(code: types.CodeType) -> Iterator[types.CodeType]:
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            yield one
            yield from _codes_of(one)


def _functions_of(code: types.CodeType) -> dict[tuple[str, int], types.CodeType]:
    """Return the code of each function of a module, also of inner ones, by name and first line, if that names one."""
    found: dict[tuple[str, int], list[types.CodeType]] = {}
    for one in _codes_of(code):
        found.setdefault((one.co_qualname, one.co_firstlineno), []).append(one)
    return {name: codes[0] for name, codes in found.items() if len(codes) == 1}


def replace_code(tree: ast.Module, path: Path) -> bool:
    """Give every function of this file, in this process, the code of the tree where it differs. False: none was."""
    wanted = _functions_of(compile(tree, str(path), "exec"))
    gc.unfreeze()
    done = 0
    for one in gc.get_objects():
        if isinstance(one, types.FunctionType) and one.__code__.co_filename == str(path):
            code = wanted.get((one.__code__.co_qualname, one.__code__.co_firstlineno))
            if code is not None and code != one.__code__:
                try:
                    one.__code__ = code
                except ValueError:                       # another set of variables of the functions around
                    return False
                done += 1
    return done > 0


def _descendants(process: int) -> list[int]:
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError):
            continue
    found = [process]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found


def wait_for(child: int, longest_s: float) -> int:
    """Return the exit code of a child; after this time it is killed with all that it began."""
    end_s, pause_s = time.monotonic() + longest_s, 0.002
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end_s:
            for one in _descendants(child):
                try:
                    os.kill(one, signal.SIGKILL)
                except ProcessLookupError:
                    continue
            os.waitpid(child, 0)
            return TIMED_OUT
        time.sleep(pause_s)
        pause_s = min(0.2, 1.3 * pause_s)


def in_child(work: Callable[[], int], log: Path | None) -> int:
    """Begin ``work`` in a child process, in a folder of its own, with its output in a file. Return its number."""
    child = os.fork()
    if child:
        return child
    code = 99
    try:
        os.chdir(tempfile.mkdtemp(prefix="mutate-"))
        hush = os.open(os.devnull if log is None else str(log), os.O_WRONLY | os.O_CREAT)
        os.dup2(hush, 1)
        os.dup2(hush, 2)
        code = work()
    finally:
        os._exit(code)


class PreparedTests:
    """A process that has collected the tests of a module. ``run``: pytest in this process, with these plugins."""

    def __init__(self, module: str, path: Path, run: Callable[[Changed, Watch], int], longest_s: float) -> None:
        self._longest_s = longest_s
        self._folder = Path(tempfile.mkdtemp(prefix="mutate-"))
        self._path = path
        requests, replies = os.pipe(), os.pipe()
        changed = Changed(module, marked(ast.parse(path.read_text("utf-8"))), path)

        def work() -> int:
            os.close(requests[1])
            os.close(replies[0])
            watch = Watch(lambda session: self._serve(session, watch, requests[0], replies[1]))
            changed.extra["_entered"] = watch.enter
            return run(changed, watch)

        self._child = in_child(work, self._folder / "log")
        os.close(requests[0])
        os.close(replies[1])
        self._requests, self._replies = os.fdopen(requests[1], "w"), os.fdopen(replies[0])
        self.trace = self._trace()

    def _serve(self, session: Any, watch: Watch, requests: int, replies: int) -> None:
        collected = not session.testsfailed
        with os.fdopen(requests) as asked, os.fdopen(replies, "w") as said:
            for line in asked:
                request = json.loads(line)
                child = os.fork() if collected else 0
                if collected and not child:
                    os._exit(self._in_grandchild(session, watch, request))
                code = wait_for(child, request["longest_s"]) if collected else 99
                print(code, file=said, flush=True)

    def _in_grandchild(self, session: Any, watch: Watch, request: dict[str, Any]) -> int:
        code = 99
        try:
            if request["tree"] is not None:
                tree = marked(pickle.loads(Path(request["tree"]).read_bytes()))
                if not replace_code(tree, self._path):
                    return NOT_REPLACED
            code = run_items(session, request["tests"])
            if request["tree"] is None:
                (self._folder / "trace.json").write_text(json.dumps([watch.took_s, watch.entered]))
        except BaseException:
            import traceback

            traceback.print_exc()
        return code

    def _ask(self, tree: Path | None, tests: list[str] | None, longest_s: float) -> int:
        try:
            print(json.dumps({"tree": None if tree is None else str(tree), "tests": tests, "longest_s": longest_s}),
                  file=self._requests, flush=True)
            return int(self._replies.readline() or 99)
        except BrokenPipeError:
            return 99

    def _trace(self) -> Trace | None:
        if self._ask(None, None, self._longest_s) != 0:
            return None
        return Trace(*json.loads((self._folder / "trace.json").read_text()))

    @property
    def said(self) -> str:
        """The last lines of pytest."""
        return (self._folder / "log").read_text(errors="replace")[-3000:]

    def replaceable(self, function: int) -> bool:
        return self.trace is not None and not self.trace.at_load(function)

    def run(self, tree: ast.Module, tests: list[str], longest_s: float) -> int:
        """Run these tests with the code of the tree. Return 0, 1 if one failed, another code for any other end."""
        file = self._folder / "tree.pickle"
        file.write_bytes(pickle.dumps(tree))
        return self._ask(file, tests, longest_s)

    def close(self) -> None:
        self._requests.close()
        self._replies.close()
        wait_for(self._child, 10.0)


def forget(module: str, rooms: tuple[str, ...]) -> None:
    """Unload the modules of these rooms, so that none keeps a reference to a loaded one."""
    if module in sys.modules:
        for name in [name for name in sys.modules if name.split(".")[0] in rooms]:
            del sys.modules[name]
