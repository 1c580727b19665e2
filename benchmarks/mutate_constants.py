"""Moves one numeric constant of the estimation or the runner by a third: a test must fail, or the number is free.

    python benchmarks/mutate_constants.py --sample 40      # of both rooms; 1 if a number is free
    python benchmarks/mutate_constants.py --only _BLUR     # constants by name
    python benchmarks/mutate_constants.py --sample 40 --seed 2 --level heavy

Each constant is multiplied by 2/3, then by 4/3, while its module is imported; nothing in the checkout is written. The
tests of its room run in a process of their own, those named after the module first, up to the first failure. A number
that no test notices needs a test, or goes. Whole numbers up to `SMALLEST`
are left out: most are positions. A room takes minutes for each number that no test notices: a night takes a sample.
"""

from __future__ import annotations

import argparse
import ast
import random
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.packaging.constants import numeric  # noqa: E402

ROOMS = ("estimation", "runner")
FACTORS = ("2/3", "4/3")
SMALLEST = 3                    # largest whole number that is taken for a position or a count of parts
_FAILED = 1                     # exit code of pytest
_RUN = """
import ast, importlib.machinery, importlib.util, sys
module, path, name, factor, *rest = sys.argv[1:]

def moved(node):
    if isinstance(node, (ast.Tuple, ast.List, ast.Set)):
        node.elts = [moved(one) for one in node.elts]
        return node
    value = eval(compile(ast.Expression(node), path, "eval"))
    other = value * eval(factor)
    return ast.Constant(round(other) if isinstance(value, int) else other)

class Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname):
        tree = ast.parse(self.get_source(fullname))
        for node in tree.body:
            targets = getattr(node, "targets", [getattr(node, "target", None)])
            for target in targets:
                if isinstance(target, ast.Name) and target.id == name:
                    node.value = moved(node.value)
                for at, one in enumerate(getattr(target, "elts", ())):
                    if one.id == name and isinstance(node.value, ast.Tuple):
                        node.value.elts[at] = moved(node.value.elts[at])
        return compile(ast.fix_missing_locations(tree), path, "exec")

class Finder:
    @staticmethod
    def find_spec(fullname, *_):
        if fullname == module:
            return importlib.util.spec_from_file_location(fullname, path, loader=Loader(fullname, path))

sys.meta_path.insert(0, Finder)
import pytest
sys.exit(pytest.main([*rest, "-q", "-x", "-n", "0", "-p", "no:cacheprovider"]))
"""


@dataclass(frozen=True)
class Number:
    """A constant at the top of a module, and where it stands."""

    path: Path
    line: int
    name: str

    def __str__(self) -> str:
        return f"{self.path.relative_to(ROOT).as_posix()}:{self.line} {self.name}"


def numbers() -> Iterator[Number]:
    """Yield the constants of the rooms."""
    for room in ROOMS:
        for path in sorted((ROOT / "tdhil" / room).rglob("*.py")):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if not isinstance(node, ast.Assign | ast.AnnAssign) or not numeric(node.value):
                    continue
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target
                several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
                pairs = (zip(target.elts, node.value.elts, strict=True)          # type: ignore[union-attr]
                         if several else [(target, node.value)])
                for one, value in pairs:
                    small = isinstance(value, ast.Constant) and isinstance(value.value, int) and value.value <= SMALLEST
                    if isinstance(one, ast.Name) and not small:
                        yield Number(path, node.lineno, one.id)


def tests_of(number: Number, wanted: list[str]) -> list[str]:
    """Return the test files of its room, those that are named after its module first."""
    if wanted:
        return wanted
    room = number.path.relative_to(ROOT / "tdhil").parts[0]
    files = sorted((ROOT / "tests" / room).rglob("test_*.py"))
    return [str(one) for one in sorted(files, key=lambda one: number.path.stem not in one.stem)]


def is_free(number: Number, factor: str, tests: list[str]) -> bool:
    """Return whether the tests pass with the constant moved."""
    module = ".".join(number.path.relative_to(ROOT).with_suffix("").parts)
    command = [sys.executable, "-c", _RUN, module, str(number.path), number.name, factor, *tests]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    if done.returncode not in (0, _FAILED):
        print(done.stdout.decode()[-500:] + done.stderr.decode()[-500:])
    return done.returncode == 0


def main() -> int:
    """Return 0 if a test notices each constant in both directions."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sample", type=int, help="number of constants, drawn at random; default: all")
    parser.add_argument("--seed", type=int, default=1, help="of the sample")
    parser.add_argument("--only", nargs="+", default=(), help="names of constants")
    parser.add_argument("--level", choices=("usual", "heavy", "long"), default="usual", help="of the tests")
    parser.add_argument("--tests", nargs="+", default=[], help="files of tests; default: those of the room")
    asked = parser.parse_args()
    found = [one for one in numbers() if not asked.only or one.name in asked.only]
    if asked.sample is not None:
        found = random.Random(asked.seed).sample(found, min(asked.sample, len(found)))
    free = 0
    for number in found:
        tests = tests_of(number, asked.tests) + ([] if asked.level == "usual" else [f"--{asked.level}"])
        unnoticed = [factor for factor in FACTORS if is_free(number, factor, tests)]
        free += bool(unnoticed)
        print(f"{number}: {'no test notices ' + ' and '.join(unnoticed) if unnoticed else 'noticed'}", flush=True)
    print(f"{free} of {len(found)} are free")
    return 1 if free else 0


if __name__ == "__main__":
    sys.exit(main())
