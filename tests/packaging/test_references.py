"""Every back-quoted name in comments, docstrings and pages exists.

In the source single back-quotes are a reference; double ones mark a parameter, a field or a literal. The pages have
single ones for everything, so there only paths, dotted names of ours, classes, calls and names_with_underscores are
looked up.
"""

from __future__ import annotations

import ast
import builtins
import re
import sys
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import pytest

pytestmark = pytest.mark.one_worker      # its fixture is expensive

ROOT = Path(__file__).parents[2]
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")
FOLDERS = (*ROOMS, "tests", "benchmarks", "docs", "examples", "deploy")
FOREIGN = {"can", "canopen", "numpy", "scipy", "pymodbus", "mcap", "foxglove", "pydantic", "yaml", "rich", "uvicorn",
           "starlette", "matplotlib", "pandas", "xarray", "dask", "paho"}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = {path.stem for path in (ROOT / "tdhil" / "cli").glob("*.py")}
CODE = re.compile(r"(?<!`)`([^`]+)`(?!`)")
WORD = re.compile(r"[A-Za-z_]\w*")
DOTTED = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*$")
CLASS = re.compile(r"(?:[A-Z][a-z0-9]+){2,}$")
PATH = re.compile(rf"[\w./-]*\w\.(?:py|md|js|mjs|css|html|j2|eds|sh|toml|yml|yaml|csv|service)$"
                  rf"|(?:{'|'.join(FOLDERS)})(?:/[\w.-]+)*/$")
OF_A_USER = re.compile(r"(?:logs/)?(?:rig|plant|result|report|trace|samples|fleet|run|accounts|request|study)\.\w+$")

EXCEPTIONS = {
    "of pymodbus 3.16, which is not used for it": {
        "FramerBase.handleFrame", "FramerRTU.decode", "ModbusBaseSyncClient.execute",
        "TransactionManager.sync_get_response"},
    "of mcap": {"breakup_chunk", "StreamReader"},
    "of uvicorn": {"limit_concurrency"},
    "of protobuf's compiler": {"_pb2.py"},
    "of canopen": {"profiles/p402.py"},
    "an interface of python-can": {"gs_usb"},
    "a schema of Foxglove": {"foxglove.Log"},
    "keys of rig.yaml in another unit, which quantities.py makes": {"probe_travel_deg", "torque_knm"},
}
# A decision record keeps its names; a later record states their changes.
OF_THEIR_DAY = {
    "drivers/cia402/link.py": "drivers/canopen/bus.py",
    "tdhil/record/schema.py": "tdhil/recording/log_format.py",
    "tdhil/record/container.py": "tdhil/recording/mcap_container.py",
    "tdhil/commands/": "tdhil/cli/",
    "cli.py": "tdhil/cli/main.py",
    "sim_bus/modbus/framing.py": "sim_bus/modbus/lines.py",
    "cli/connection.py": "session/connection.py",
    "tdhil/protocol/beside.py": "tdhil/runner/background.py",
    "runner.py": "tdhil/runner/five_stages.py",
    "tdhil.drivers": "drivers",
    "tdhil.session.buses": "tdhil.buses",
    "tdhil.cli.buses": "tdhil.buses",
    "tdhil/cli/scan_common.py": "tdhil/buses/bus.py",
    "profiles/face.py": "profiles/lazy.py",
    "BusKind": "tdhil.buses.Bus",
    "BusCommands": "tdhil.buses.Bus",
    "LineConfig": "tdhil.buses.Line",
}
KNOWN = set().union(*EXCEPTIONS.values())


@dataclass
class Module:
    """Definitions and identifiers of one file."""

    path: Path
    members: set[str] = field(default_factory=set)
    classes: dict[str, set[str]] = field(default_factory=dict)
    words: set[str] = field(default_factory=set)
    texts: list[tuple[int, str]] = field(default_factory=list)     # docstrings and comments; a comment's line is < 0

    @cached_property
    def dotted(self) -> str:
        parts = self.path.relative_to(ROOT).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def read(path: Path) -> Module:
    source = path.read_text(encoding="utf-8")
    module = Module(path)
    lines = source.split("\n")
    statements: list[tuple[ast.stmt, set[str] | None]] = []

    def look(node: ast.AST, names: set[str] | None) -> None:
        """Scan a body. ``names``: those of its module or class; None inside a function."""
        body = getattr(node, "body", [])
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = body[0] if body else None
            if (isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
                    and isinstance(first.value.value, str)):
                module.texts.append((first.lineno, first.value.value))
                lines[first.lineno - 1:first.end_lineno] = [""] * ((first.end_lineno or 0) - first.lineno + 1)
        for part in (body, getattr(node, "orelse", []), getattr(node, "finalbody", []), getattr(node, "handlers", [])):
            statements.extend((one, names) for one in part)

    look(ast.parse(source), module.members)
    while statements:
        node, names = statements.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and names is not None:
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            own = module.classes.setdefault(node.name, set())
            own |= set(re.findall(r"\bself\.(\w+)", "\n".join(lines[node.lineno - 1:node.end_lineno])))
            own |= {f"<{ast.unparse(base).rpartition('.')[2].partition('[')[0]}>" for base in node.bases}
            look(node, own)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            look(node, None)
        else:
            if names is not None and isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names.update(one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name))
            elif names is not None and isinstance(node, ast.Import | ast.ImportFrom):
                names.update((one.asname or one.name).partition(".")[0] for one in node.names)
            look(node, names)
    for number, line in enumerate(lines):
        code, mark, comment = line.partition("#") if line.lstrip().startswith("#") else line.partition("  #")
        lines[number] = code
        if not mark:
            continue
        if number and not code.strip() and module.texts and module.texts[-1][0] == -number:
            module.texts[-1] = (-number - 1, f"{module.texts[-1][1]} {comment.strip(' :#')}")    # continued
        else:
            module.texts.append((-number - 1, comment.strip(" :#")))
    module.words = set(WORD.findall("\n".join(lines)))
    return module


class House:
    """All modules of all rooms."""

    def __init__(self) -> None:
        self.modules = [read(path) for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
        self.by_end: defaultdict[str, list[Module]] = defaultdict(list)
        self.classes: defaultdict[str, list[set[str]]] = defaultdict(list)
        self.names = {*dir(builtins), *ROOMS}
        for module in self.modules:
            parts = module.dotted.split(".")
            for n in range(len(parts)):
                self.by_end[".".join(parts[n:])].append(module)
            self.names |= module.members
            for name, members in module.classes.items():
                self.classes[name].append(members)
        self.words = set().union(*(module.words for module in self.modules)) | self.names
        for name in ("pyproject.toml", "mkdocs.yml"):
            self.words |= set(re.findall(r"\w+", (ROOT / name).read_text(encoding="utf-8")))
        self.files = [path.relative_to(ROOT).as_posix() for folder in FOLDERS for path in (ROOT / folder).rglob("*")
                      if "__pycache__" not in path.parts]
        self.files += [path.name for path in ROOT.iterdir()] + [".ci/run"]
        # The path of each file and all its trailing parts, so that a name is found without a search.
        self.ends = {file.split("/", n)[-1] for file in self.files for n in range(file.count("/") + 1)}

    def in_class(self, name: str, member: str, seen: frozenset[str] = frozenset()) -> bool:
        for members in self.classes.get(name, ()):
            bases = {base[1:-1] for base in members if base[0] == "<"}
            if member in members or any(base not in self.classes or self.in_class(base, member, seen | {name})
                                        for base in bases - seen - {"Generic", "Protocol"}):
                return True
        return False

    def has_file(self, name: str, near: Path) -> bool:
        name = name.removeprefix("./").rstrip("/")
        return name in self.ends or (near.parent / name).exists()

    def resolves(self, name: str) -> bool:
        """Return whether ``name`` is a module, or a member of a module or class."""
        if name in self.by_end:
            return True
        head, _, last = name.rpartition(".")
        if any(last in module.members for module in self.by_end.get(head, ())):
            return True
        before, _, owner = head.rpartition(".")
        return self.in_class(owner, last) and (not before or self.resolves(head))


@pytest.fixture(scope="module")
def house() -> House:
    return House()


def is_known(name: str) -> bool:
    return name in KNOWN or bool(OF_A_USER.match(name))


def room_of(dotted: str) -> str:
    """Return the package in whose modules one word is sufficient for a name: ``tdhil.runner``, ``drivers``."""
    parts = dotted.split(".")
    return ".".join(parts[:2]) if parts[0] == "tdhil" else parts[0]


def in_source(house: House, module: Module, name: str) -> bool:
    """Return whether a reference of a comment or docstring resolves, or is no reference."""
    name = name.removesuffix("()")
    if PATH.match(name) and not DOTTED.match(name.removesuffix(".py")):
        return house.has_file(name, module.path)
    if PATH.match(name) and house.has_file(name, module.path):
        return True
    if not DOTTED.match(name):
        return True
    first, _, rest = name.partition(".")
    if not rest:
        return (name in module.words or name in house.names or name in COMMANDS
                or any(room_of(other.dotted) == room_of(module.dotted) for other in house.by_end.get(name, ())))
    if house.resolves(name):
        return True
    if first in ROOMS or first in house.classes or name.rpartition(".")[0] in house.by_end:
        return False
    if first in sys.stdlib_module_names or first in FOREIGN:
        return True
    return first in module.words and all(part in house.words for part in rest.split("."))


def test_every_reference_of_the_source_resolves(house):
    found = [f"{module.path.relative_to(ROOT)}:{abs(line)}: {name}" for module in house.modules
             for line, text in module.texts for name in CODE.findall(text)
             if not is_known(name) and not in_source(house, module, " ".join(name.split()))]
    assert found == []


def on_page(house: House, page: Path, name: str) -> bool:
    """Return whether a back-quoted name of a page resolves, or is no name of tdhil."""
    if re.search(r"[A-Z]{3}|[<>*… {}]", name) and not CLASS.match(name):
        return True
    path, _, test = name.partition("::")
    if PATH.match(path):
        if not house.has_file(path, page):
            return False
        return not test or f"def {test.partition('[')[0]}(" in (ROOT / path).read_text(encoding="utf-8")
    if "/" in path and path.partition("/")[0] in FOLDERS:
        return house.has_file(path, page)
    name = name.removesuffix("()")
    if not DOTTED.match(name):
        return True
    first, _, rest = name.partition(".")
    if not rest:
        return not ("_" in name or CLASS.match(name)) or name in house.words or name in house.by_end
    return house.resolves(name) or first not in (*ROOMS, *house.classes)


def test_every_reference_of_the_pages_resolves(house):
    found = [f"{page.relative_to(ROOT)}:{line}: {name}" for page in PAGES
             for line, text in enumerate(page.read_text(encoding="utf-8").split("\n"), 1) for name in CODE.findall(text)
             if not is_known(name) and not on_page(house, page, name)
             and not (page.parent.name == "decisions" and name in OF_THEIR_DAY)]
    assert found == []


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("gone", ["let_go", "verdict.conclude", "tdhil.runner.let_go", "Guard.looks_away",
                                  "gone_file.py", "tdhil/runner/gone.py", "control_loop.gone()"])
def test_a_removed_name_is_found(house, gone):
    (guard,) = house.by_end["tdhil.runner.guard"]
    assert not in_source(house, guard, gone)


@pytest.mark.parametrize("gone", ["let_go_of", "WorkerOfOld", "tdhil.runner.let_go", "tdhil/runner/gone.py",
                                  "tests/packaging/test_house.py::test_gone", "Guard.looks_away", "gone_thing()"])
def test_a_removed_name_is_found_on_a_page(house, gone):
    assert not on_page(house, ROOT / "README.md", gone)


def test_renamed_things_of_decisions_are_at_the_place_in_the_table(house):
    assert [new for new in OF_THEIR_DAY.values() if not on_page(house, ROOT / "README.md", new)] == []


def test_no_exception_is_unused(house):
    texts = [text for module in house.modules for _, text in module.texts]
    texts += [page.read_text(encoding="utf-8") for page in PAGES]
    assert [name for name in (*KNOWN, *OF_THEIR_DAY) if not any(f"`{name}`" in text for text in texts)] == []
