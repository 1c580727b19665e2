"""Pages name no option of the command line: texts in the browser have the label of the field instead."""

from __future__ import annotations

import ast
import re
import shutil
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tdhil.buses import keys_by_flag
from tdhil.config import OF_A_TRACE, OF_EVIDENCE, OPTION, OPTIONS
from tdhil.service.languages import languages
from tdhil.service.worker import WORK
from tests.service.catalogue import ELSEWHERE, ROOT, TEMPLATES
from tests.service.test_languages import in_script

FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
COMMAND = re.compile(r"tdhil [a-z]+[^;:,()`]*? --[a-z][^;:,()`]*")
ROOMS = ("drivers", "profiles", "sim_bus/fault_script.py", "sim_bus/modbus/faults.py", "tdhil/buses",
         "tdhil/calibration", "tdhil/config", "tdhil/estimation", "tdhil/evidence", "tdhil/fleet", "tdhil/recording",
         "tdhil/report", "tdhil/runner", "tdhil/service", "tdhil/session")
"""Rooms whose texts a page may show."""
OF_THE_TERMINAL = {
    "profiles/messages.py": "the pages show only the titles, which the next test reads",
    "tdhil/buses/canopen.py": "names of settings, and sources in the table of settings",
    "tdhil/buses/modbus.py": "options of tdhil scan",
    "tdhil/config/rig.py": "for a run without a rig's file, which no page starts",
    "tdhil/fleet/cluster.py": "tdhil fleet on a cluster",
    "tdhil/fleet/table.py": "the table of tdhil fleet",
    "tdhil/fleet/trend.py": "the choice of a rig, which a page has made",
    "tdhil/recording/csv/layout.py": "the column of a reference sensor",
    "tdhil/report/figure_words.py": "figures of tdhil tune",
    "tdhil/report/graphs.py": "graphs of tdhil tune",
    "tdhil/report/html.py": "the path of a report",
    "tdhil/report/speed_loop.py": "tdhil tune speed",
    "tdhil/report/tuning.py": "tdhil tune soft-torque",
    "tdhil/runner/planning.py": "a plan of run.impedance: offset: there is none",
    "tdhil/runner/stages/speed_steps.py": "tdhil verify",
    "tdhil/runner/stages/virtual_string.py": "tdhil evaluate",
    "tdhil/runner/virtual_string_program.py": "tdhil evaluate",
    "tdhil/service/new_rig.py": "arguments of a process",
    "tdhil/service/supervisor.py": "arguments of a process",
    "tdhil/session/evaluation.py": "tdhil evaluate",
    "tdhil/calibration/reference.py": "tdhil calibrate torque with a reference sensor",
    "tdhil/session/speed_calibration.py": "tdhil calibrate speed",
    "tdhil/session/stored_calibration.py": "the file of a calibration",
}
"""Modules with options that no page has, each with its reason. Those of `ELSEWHERE` also belong to the terminal."""


def texts_of(path: Path) -> Iterator[str]:
    """Yield the texts of a module without its docstrings; a value in a text is 7."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    pieces = {id(one) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for one in node.values}
    pieces |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(one.value) if isinstance(one, ast.Constant) else "7" for one in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in pieces:
            yield node.value


@cache
def texts_with_flags() -> list[tuple[str, str]]:
    """Return (module, text) of each text that names an option outside a whole command."""
    paths = [path for room in ROOMS for path in ((ROOT / room).rglob("*.py") if (ROOT / room).is_dir()
                                                 else (ROOT / room,))]
    found = [(path.relative_to(ROOT).as_posix(), text) for path in sorted(paths) for text in texts_of(path)]
    return [(place, text) for place, text in found if FLAG.search(COMMAND.sub("", text))]


def flags_of_pages() -> set[str]:
    """Return the options whose field a template marks directly."""
    return set(re.findall(r'data-flag="(--[a-z-]+)"', "".join(path.read_text("utf-8") for path in TEMPLATES)))


@pytest.mark.heavy(each_share=True)
def test_each_option_in_a_text_of_a_page_has_a_name_there():
    known = {*languages()["en"].labels(), *flags_of_pages()}
    found = {(place, flag) for place, text in texts_with_flags() for flag in FLAG.findall(COMMAND.sub("", text))}
    assert len(found) > 100
    unnamed = {place for place, flag in found if flag not in known}
    assert unnamed - {f"tdhil/service/{name}" for name in ELSEWHERE} == OF_THE_TERMINAL.keys()


@pytest.mark.parametrize("tag", languages())
def test_the_name_is_the_label_else_the_key_in_the_rig_s_file_else_a_command(tag):
    language = languages()[tag]
    names = language.labels()
    for one in (*OPTIONS, *OF_A_TRACE, *OF_EVIDENCE):
        if one.label and one.flag != OPTION["excitation"].flag:
            assert names[one.flag] == f"“{language.word(one.label)}”"
    assert names["--excitation"] == f"“{language.word('Motion')}”"            # the label of a run, not that of a trace
    assert {"en": "“modbus.unit” (rig's file)", "de": "“modbus.unit” (Datei der Anlage)"}[tag] == names["--unit"]
    assert (names["--yes"], names["--columns"]) == ("“tdhil identify --yes”", "“tdhil replay --columns”")
    assert set(keys_by_flag()) <= names.keys()


def replaced(tag: str, *texts: str) -> list[object]:
    if shutil.which("node") is None:
        pytest.skip("no node: tests/service/chromium/test_option_names.py shows the same in Chromium")
    return in_script(tag, *(["byLabels", text] for text in texts))


@pytest.mark.heavy
def test_no_text_of_a_page_keeps_an_option():
    """The check covers each room below the pages, in the form shown on a page."""
    known, own = languages()["en"].labels(), flags_of_pages()
    texts = [text for _, text in texts_with_flags() if set(FLAG.findall(COMMAND.sub("", text))) <= known.keys() - own]
    shown = [str(one) for one in replaced("en", *texts)]
    assert len(shown) > 150
    assert [one for one in shown if FLAG.search(re.sub("“tdhil [^”]*”", "", COMMAND.sub("", one)))] == []


@pytest.mark.heavy
def test_a_command_stays_and_an_unknown_option_too():
    texts = ("Give --max-time 146s or more, not --max-times", "at --mode: use -i eth1", "x--mode, -unit, a - b",
             "Measure it with tdhil identify --impedance, or lower --rate", "tdhil replay run.mcap --model rigid",
             "Start it with tdhil serve --rigs DIR", "tdhil tune speed r.json --string s.yaml --json > tune.json")
    assert replaced("en", *texts) == [
        "Give “Longest duration of stage 5, minutes” 146s or more, not --max-times",
        "at “Controlled quantity”: use “interface” (rig's file) eth1", texts[2],
        "Measure it with tdhil identify --impedance, or lower “Control cycles per second”", *texts[4:]]
    german = ("Give “Längste Dauer der Stufe 5, Minuten” 146s or more, not --max-times",
              "add “tdhil identify --yes” or “--x”")
    assert replaced("de", texts[0], "add --yes or “--x”", *german) == [*german, *german]      # repeated calls


@pytest.mark.heavy
def test_every_refusal_of_a_request_is_shown_without_an_option(client, service, monkeypatch):
    """The requests are a start, a plan, a rehearsal, a calibration and an acceptance, in each language."""
    run = service.supervisor.start_run("a", {"note": "done"}, "local").request.id
    service.wait(run, "done")
    monkeypatch.setattr(service.supervisor, "work", lambda what, run, asked: WORK[what](asked))
    calibration = {"without": run, "with_body": run, "added_kg_m2": 55.0, "at": "motor"}
    sent = [
        ("rigs/a/plan", {"max_time_s": 20}), ("rigs/a/plan", {"frequency_hz": 1000}), ("rigs/a/plan", {"mode": "x"}),
        ("rigs/a/plan", {"excitation": "coast-down", "frequency_hz": 1, "realisations": 3}),
        ("rigs/a/plan", {"tolerance": "lots", "max_time_s": -5}), ("rigs/a/plan", {"model": "x", "periods": 0}),
        ("rigs/a/runs", {"fault": ["x"]}), ("rigs/a/runs", {"fault": ["sto@nowhere"]}), ("rigs/a/runs", {"yes": True}),
        ("rigs/a/runs", {"fault": ["not a fault"]}), ("rigs/a/runs", {"expect": ["J=1"]}), ("rigs/a/runs", {"x": 1}),
        ("rigs/real/runs", {"accept_no_watchdog": True, "seed": 7}),
        ("rigs/real/plan", {"rate_hz": 1e6}), ("rigs/never/runs", {}), ("rigs/broken/runs", {}),
        ("rigs/a/calibration", calibration), ("rigs/a/calibration", {**calibration, "added_kg_m2": -1.0}),
        (f"runs/{run}/acceptance", {"name": "A", "remark": "", "verdict": "pass", "log_sha256": "0" * 64}),
    ]
    found = [(path, body, client.post(f"/api/v1/{path}", json=body)) for path, body in sent]
    assert [(path, body) for path, body, answer in found if answer.status_code < 400] == []
    documents = [answer.json() for _, _, answer in found]
    assert any("--max-time" in one["error"]["message"] for one in documents)       # the text of the API has it
    said = [text for one in documents for text in (one["error"]["message"], *(
        wrong["message"] for wrong in one.get("fields") or ()))]
    for tag in languages():
        shown = [*replaced(tag, *said), *in_script(tag, *(["errorText", one["error"]] for one in documents))]
        assert [one for one in shown if "--" in COMMAND.sub("", str(one))] == []
