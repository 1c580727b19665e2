"""An option is declared once, in one line of the table. Every place with options has it, and no other file names it.

The first test adds a line to a copy of the package and looks in all six places. The last ones read every source file.
"""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import tdhil
from tdhil.cli.main import main
from tdhil.config.options import ASKED_AGAIN, OF_EVIDENCE, OPTION, OPTIONS, RunOptions, form_options
from tdhil.config.reference import page_of
from tdhil.config.registry import BUSES, EXCITATIONS, MODELS

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "tdhil"
TABLE = Path("tdhil/config/options.py")

LINE = """\
    dwell_s: float | None = option("--dwell", "run.dwell_s", group=Topic.MOTION, unit=TIME, ge=0, le=60, api=True, \
form=Form("Dwell, s"), help="time at the mean speed before stage 5")
"""
BEFORE = "    settings: Mapping[str, Setting] = field(default_factory=dict)\n"

LOOK = """
import contextlib, inspect, io, json, sys
from pathlib import Path
import tdhil
from tdhil.cli.main import main
from tdhil.config import load_rig, resolve
from tdhil.config.reference import page_of
from tdhil.service.schemas import document
from tdhil.service.start_request import options_of
import jinja2, tdhil.service
from tdhil.config import form_options

assert Path(tdhil.__file__).is_relative_to(Path.cwd()), tdhil.__file__
said = io.StringIO()
with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
    main(["identify", "--help-all"])
rig = Path("rig.yaml")
rig.write_text("run: {dwell_s: 1500 ms}\\n")
from tdhil.cli.main import build_parser
parsed = build_parser("identify").parse_args(["identify", "--dwell", "2500ms"])
templates = jinja2.Environment(loader=jinja2.FileSystemLoader(Path(tdhil.__file__).parent / "service" / "templates"))
templates.globals.update(form_options=form_options, word=lambda text, context="": text, hint=lambda option: "")
field = templates.from_string('{% from "option.html" import fields %}{{ fields(form_options("run")) }}').render()
schemas = document()["paths"]["/api/v1/rigs/{rig}/runs"]["post"]["requestBody"]["content"]["application/json"]["schema"]
print(json.dumps({
    "help": said.getvalue(), "command line": resolve(vars(parsed), None).dwell_s,
    "rig.yaml": resolve({}, load_rig(rig)).dwell_s, "source": resolve({}, load_rig(rig)).source("dwell_s"),
    "python": "dwell_s" in inspect.signature(tdhil.run).parameters,
    "api": options_of({"dwell": "2 s"}), "schema": schemas["properties"].get("dwell_s"), "form": field,
    "page": page_of(Path("docs/reference/rig.md").read_text(encoding="utf-8")),
}))
for wrong in ({"dwell_s": 61.0}, {"dwell": 1.0}):
    with tdhil.simulate(seed=7) as drive:
        try: tdhil.run(drive, log="none.mcap", **wrong)
        except tdhil.TdhilError as error: print(error)
"""


@pytest.mark.heavy
def test_an_option_is_added_in_one_line_and_is_there_in_all_six_places(tmp_path):
    pytest.importorskip("jinja2", reason="jinja2 is not installed (pip install '.[service]')")
    shutil.copytree(PACKAGE, tmp_path / "tdhil", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("drivers", "profiles", "sim_bus"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "docs" / "reference").mkdir(parents=True)
    shutil.copy(ROOT / "docs" / "reference" / "rig.md", tmp_path / "docs" / "reference")
    table = tmp_path / TABLE
    text = table.read_text(encoding="utf-8")
    assert text.count(BEFORE) == 1
    table.write_text(text.replace(BEFORE, LINE + BEFORE), encoding="utf-8")
    done = subprocess.run([sys.executable, "-c", LOOK], cwd=tmp_path, capture_output=True, text=True, timeout=300,
                          env={**os.environ, "PYTHONPATH": str(tmp_path), "COLUMNS": "80"})
    assert done.returncode == 0, done.stderr
    found, *refused = done.stdout.splitlines()
    seen = json.loads(found)
    assert re.search(r"--dwell DWELL_S\s+time at the mean speed before stage 5", seen["help"])
    assert seen["command line"] == 2.5
    assert (seen["rig.yaml"], seen["source"]) == (1.5, "rig.yaml:1")
    assert seen["python"]
    assert seen["api"] == {"dwell_s": 2.0} and seen["schema"]["x-unit"] == "s"
    assert re.search(r"Dwell, s</span>\s*<input name=\"dwell_s\"", seen["form"])
    row = "| `run.dwell_s` | – | `--dwell` | s; time at the mean speed before stage 5 |"
    assert row in seen["page"].splitlines()
    assert "dwell_s: must be at most 60, not 61" in refused[0] and "--dwell" not in refused[0]
    assert "unknown option: dwell" in refused[1]


# ---------------------------------------------------------------------------------------------------------------------
# Each place alone


def test_the_page_on_rig_yaml_is_what_the_table_makes_of_it():
    text = (ROOT / "docs" / "reference" / "rig.md").read_text(encoding="utf-8")
    assert page_of(text) == text, "stale: python -m tdhil.config.reference"


@pytest.mark.parametrize("command", [
    "identify", "evaluate", "replay", "fleet", "watch", "compare", "scan", "doctor", "stop",
])
def test_help_fits_a_terminal(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    one_word = re.compile(r"\s+\[-\S+ \{\S+\}\]|.*canalystii.*")     # choices in one piece, which argparse never breaks
    assert [line for line in text.splitlines() if len(line) > 80 and not one_word.fullmatch(line)] == []


def test_every_option_has_its_own_sentence_and_flag():
    assert all(option.help and option.flag.startswith("--") for option in OPTIONS)
    assert len({option.flag for option in OPTIONS}) == len({option.keyword for option in OPTIONS}) == len(OPTIONS)
    assert all("{" not in option.help_text for option in OPTIONS)


def test_a_default_is_within_its_limits():
    for option in OPTIONS:
        if option.limits and option.kind is not str and option.default is not None:
            assert option.refusal(option.default) == ""
        assert not option.allowed or option.default in (*option.allowed, None)


@pytest.mark.parametrize(("value", "said"), [(0.4, "at least 0.5 and less than 1"), (1.0, "less than 1"), (0.5, ""),
                                             (float("nan"), "at least 0.5")])
def test_a_value_beyond_its_limits_is_refused_with_both(value, said):
    assert said in OPTION["confidence"].refusal(value)
    assert bool(said) == bool(OPTION["confidence"].refusal(value))


@pytest.mark.parametrize(("name", "value", "said"), [
    ("max_time", -5.0, "greater than 0 and at most 1e+07"), ("max_time", 1e-7, "at least 1e-06 and at most 1e+07"),
    ("tolerance", 1.0, "greater than 0 and less than 1. 1 means 100 %. For 1 % write 1% or 0.01"),
    ("tolerance", 0.0, "greater than 0 and less than 1"),
])
def test_a_refused_number_is_stated_with_its_meaning(name, value, said):
    (option,) = (one for one in OPTIONS if one.flag == f"--{name.replace('_', '-')}")
    assert option.refusal(value) == said


def test_python_shows_its_keywords():
    run, simulate, identify = (inspect.signature(one).parameters for one in (tdhil.run, tdhil.simulate, tdhil.identify))
    assert {"drive", "motion", "confirm", "stop", "tolerance", "max_time_s", "no_watchdog", "note"} <= set(run)
    assert not {"yes", "json", "simulate", "seed", "node"} & set(run)
    assert {"rig", "seed", "plant", "drive", "profile", "faults", "real_time"} <= set(simulate)
    assert set(identify) == {"recorded", "model", "confidence", "tolerance"}


def test_an_unknown_keyword_is_refused_with_the_known_ones():
    with pytest.raises(tdhil.TdhilError, match="unknown option: sed") as caught, tdhil.simulate(sed=7):
        pass
    assert "seed" in str(caught.value)


def test_the_forms_have_every_excitation_and_model():
    (motion,) = (one for one in form_options("run") if one.name == "excitation")
    assert motion.allowed == tuple(EXCITATIONS)
    (model,) = (one for one in form_options("replay") if one.name == "model")
    assert model.allowed == tuple(MODELS)


def test_a_log_without_settings_of_its_own_has_the_documented_tolerance(monkeypatch):
    """It is 0.05, as in docs/reference/rig.md and the help of replay. It used to be 0.02."""
    from tdhil import estimation
    from tdhil.session.conclusion import conclude

    class Reached(Exception):
        pass

    def identify(recording, options):
        raise Reached(options)

    monkeypatch.setattr(estimation, "identify", identify)
    with pytest.raises(Reached) as caught:
        conclude(None, {}, "run.mcap")
    (options,) = caught.value.args
    assert options == estimation.Options(tolerance=0.05, confidence=0.95, model="auto")
    assert RunOptions().tolerance == 0.05
    assert {one.name: one.default for one in ASKED_AGAIN} == {"tolerance": 0.05, "confidence": 0.95, "model": "auto"}


# ---------------------------------------------------------------------------------------------------------------------
# No second file

DECLARED = {"config/options.py", "config/registry.py"}
NAMES = {text for option in OPTIONS for text in (
    option.name, option.keyword, option.flag, option.at, option.flag.removeprefix("--").replace("-", "_"),
) if text}
CHOICES = {choice for option in OPTIONS for choice in option.allowed} | {*EXCITATIONS, *MODELS, *BUSES}
ORDINARY = {word for word in NAMES if word.isalpha()} | {
    *BUSES, "torque", "speed", "offset", "reference", "string", "step", "paper", "auto", "rigid",
    "rate_hz", "frequency_hz", "amplitude_rad_s", "offset_rad_s", "speed_unit",
}
"""Plain words and quantities, searched in pages and scripts only.

Python files also use them as keys of a document, as signals or as stages. For buses, `tests/config/test_registry.py`
checks that no code compares with their names.
"""

EXCEPTIONS: dict[str, tuple[str, set[str]]] = {
    "evidence/making.py": ("a key of the result document", {"order_number"}),
    "api.py": ("classes of the motions that ship, for their users", {"coast-down", "pulses", "multisine", "sine"}),
    "buses/canopen.py": ("the flag that means this bus, and to type where a scan found several drives", {"--node"}),
    "cli/main.py": ("arguments that could not be parsed; it loads no table", {"--json"}),
    "cli/profiles.py": ("said before or after its own sub-commands", {"--json"}),
    "cli/rig_new.py": ("the profile to begin a rig.yaml for, required", {"--profile"}),
    "cli/study.py": ("a study's settings, by the names of its own schema", {"--seed", "sine"}),
    "cli/tune_soft_torque.py": ("files and profile of a tuning, not of a run", {"--impedance", "--profile"}),
    "cli/tune_speed.py": ("files and profile of a tuning, not of a run", {"--impedance", "--profile"}),
    "estimation/cross_checks/second_opinion.py": ("what a recording says of its motion", {"coast-down"}),
    "estimation/frequency_domain/compliant.py": ("the model that this file fits", {"two-mass"}),
    "estimation/samples.py": ("what a recording says of its motion", {"multisine", "sine"}),
    "runner/preconditions.py": ("advice in a refusal, as flags to type", {"--excitation", "--impedance"}),
    "runner/speed_check.py": ("advice in a refusal, as a flag to type", {"--accept-speed-unit"}),
    "runner/stages/impedance.py": ("the motion that this stage makes", {"multisine"}),
    "session/confirm.py": ("advice in a refusal, as a flag to type", {"--accept-speed-unit"}),
    "session/task.py": ("the place of a mistake, as a flag to type", {"--highest-speed"}),
    "session/overrides.py": ("decides what this option means", {"accept_unverified"}),
    "service/access.py": ("what an engineer alone may ask for: a rule of roles",
                          {"accept_unverified", "accept_wider_limit", "accept_speed_unit"}),
    "service/new_rig.py": ("keys of a new rig.yaml; the command line of tdhil scan", {
        "accept_unverified", "--json"}),
    "evidence/log_scrub.py": ("keys of a configuration that stay in evidence", {"accept_unverified"}),
    "service/static/new_rig.js": (
        "keys of a new rig.yaml, and a value of its picture", {"accept_unverified", "profile", "string", "torque"}),
    "service/templates/new_rig.html": ("keys of a new rig.yaml", {"profile", "string"}),
    "service/start_request.py": ("a key of rig.yaml that may be edited", {"accept_unverified"}),
    "service/supervisor.py": ("the command line of tdhil stop", {"--json"}),
    "soft_torque/evaluation.py": ("advice in a refusal; this room knows no table", {"--rate"}),
    "studies/coverage/simulate.py": ("the motion of a simulation without a bus", {"multisine"}),
    "studies/paper/design_runs.py": ("the paper's own motions", {"sine"}),
    "studies/paper/figures.py": ("the paper's own motions", {"sine"}),
    "studies/paper/loop.py": ("the paper's own motions", {"multisine", "sine"}),
    "studies/paper/sweeps.py": ("the paper's own motions", {"sine"}),
    "service/static/app.js": (
        "a role, signals of the plots, the key of a sign-off, the clock that a page measures, values in a text, the"
        " field that a careful first motion fills", {
            "drive", "excitation", "highest_speed_rad_s", "mode", "note", "operator", "place", "step", "speed",
            "torque", "real_time"}),
    "service/static/results.js": (
        "a rehearsal's request; keys of answers; a role; a column of the friction table and of a chart's CSV; the type"
        " of a value", {
            "fault", "faults", "frequency_hz", "log", "model", "note", "operator", "real_time", "speed", "string",
            "yes"}),
    "service/static/letterhead.js": ("the page and the route of the service's own letterhead", {"letterhead"}),
    "service/static/upload.js": (
        "quantities of a trace, a kind of file, a role, keys of a preview", {
            "drive", "log", "note", "operator", "profile", "rate", "speed", "torque", "trace"}),
    "service/templates/run.html": ("what was seen, for a sign-off", {"note"}),
}
"""File → (reason, names that it may contain)."""


def stated(path: Path) -> Iterator[str]:
    """Return the names in a source file: texts of a Python file; in a page or script fields and properties too."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value not in ORDINARY:
                yield node.value
    elif path.suffix == ".js":
        yield from re.findall(r"""(?<=["'`])[\w.-]+(?=["'`])""", text)
        yield from re.findall(r"\belements\.(\w+)", text)
        yield from re.findall(r"[{,]\s*(\w+):\s", text)
    else:
        yield from re.findall(r"""\b(?:name|value)="([\w.-]+)\"""", text)
        yield from re.findall(r"<option[^>]*>\s*([\w.-]+)\s*<", text)


FILES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*")
               if path.suffix in (".py", ".js", ".html") and "uPlot" not in path.name)


@pytest.mark.heavy(but_first=58, each_share=True)
@pytest.mark.parametrize("file", FILES)
def test_no_name_of_an_option_stands_in_a_second_file(file):
    if file in DECLARED:
        return
    allowed = EXCEPTIONS.get(file, ("", set()))[1]
    found = {name for name in stated(PACKAGE / file) if name in NAMES | CHOICES}
    assert found - allowed == set(), "an option is declared only in tdhil/config/options.py: take it from OPTION"
    assert allowed - found == set(), "an unused exception"


def test_no_flag_of_the_statement_is_in_a_second_file():
    flags = {one.flag for one in OF_EVIDENCE} - {one.flag for one in OPTIONS}
    assert len(flags) == len(OF_EVIDENCE)
    there = {file for file in FILES for flag in flags
             if file.endswith(".py") and f'"{flag}"' in (PACKAGE / file).read_text("utf-8")}
    assert there == {"config/options.py"}


def test_every_exception_is_of_a_file_and_has_a_reason():
    assert set(EXCEPTIONS) <= set(FILES)
    assert all(len(reason) > 5 for reason, _ in EXCEPTIONS.values())


@pytest.mark.parametrize(("name", "text"), [
    ("page.html", '<option>sine</option>'), ("page.html", '<input name="max_time">'), ("a.js", 'body.x = "two-mass"'),
    ("a.js", "form.elements.tolerance"), ("a.js", "({ seed: 7 })"), ("a.py", 'x = "--tolerance"'),
    ("a.py", 'x = {"max_time_s": 1}'), ("a.py", 'x = "coast-down"'),
])
def test_a_second_place_is_found(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    assert set(stated(path)) & (NAMES | CHOICES)
