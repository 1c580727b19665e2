"""Table of messages: permanent, unique codes, each with an exit code, a cause and a remedy."""

from __future__ import annotations

import ast
import copy
import json
import pickle
import re
from importlib import import_module
from pathlib import Path

import pytest

from profiles import CodedText, MessageCode, TdhilError, entry_of, message_of
from tdhil.cli.explain import GROUPS, page
from tdhil.cli.main import main
from tdhil.errors import ExitCode, Interrupted, LogError, code_of, exit_code

ROOT = Path(__file__).parents[2]
GOLDEN = Path(__file__).with_name("message_codes.txt")
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")
LONGEST = 25
EXIT_OF_THE_CALLER = {"LogError", "NothingRecorded", "ServiceError", "RunRefused"}
"""Errors whose exit code is that of the run or of the command."""


def test_codes_are_unique_and_permanent():
    """An entry of the golden list is never changed: scripts and manuals name it. New ones are added to the list."""
    codes = [f"{entry.code} {entry.name}" for entry in MessageCode]
    assert len({entry.number for entry in MessageCode}) == len(codes)
    assert codes == sorted(codes, key=lambda row: int(row.split()[0].removeprefix("TDH-")))
    assert codes == GOLDEN.read_text(encoding="utf-8").split("\n")[:-1]


@pytest.mark.parametrize("entry", MessageCode, ids=lambda entry: entry.code)
def test_cause_and_cure_are_short_sentences(entry):
    assert entry.group in GROUPS
    assert entry.title[0].isupper() and not entry.title.endswith(".")
    for text in (entry.cause, entry.cure):
        assert text.endswith(".")
        for sentence in re.split(r"(?<=[.;:!?])\s", text):
            assert sentence[0].isupper() or sentence.startswith(("tdhil", "python-can", "--")) or "; " in text, sentence
            assert len(sentence.split()) <= LONGEST, sentence


def test_each_group_is_an_exit_code():
    values = {int(code) for code in ExitCode}
    assert {group for group in GROUPS if group < 13} == values - {130, 143}


def _error_classes(kind=TdhilError):
    for one in kind.__subclasses__():
        if one.__module__.split(".")[0] in ROOMS:
            yield one
            yield from _error_classes(one)


def _raised():
    """Yield each call in the tree that names an entry: file and line, class, entry."""
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            if "MessageCode." not in text:
                continue
            for call in (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)):
                for word in call.keywords:
                    if word.arg == "entry" and ast.unparse(word.value).startswith("MessageCode."):
                        entry = MessageCode[ast.unparse(word.value).partition(".")[2]]
                        yield f"{path.relative_to(ROOT)}:{call.lineno}", ast.unparse(call.func), entry


@pytest.mark.heavy
def test_the_code_of_an_error_belongs_to_its_exit_code():
    for path in sorted((ROOT / "tdhil").rglob("*.py")):
        if "TdhilError)" in path.read_text(encoding="utf-8"):
            import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    classes = {one.__name__: one for one in _error_classes()} | {"TdhilError": TdhilError}
    codes = {}
    for name, kind in classes.items():
        bare = kind.__new__(kind)
        codes[name] = 13 if kind is Interrupted else int(exit_code(bare))
        if name not in EXIT_OF_THE_CALLER:
            assert kind.entry.group == codes[name], name
    wrong = [f"{where}: {name} ends with {codes[name]}, {entry.code}" for where, name, entry in _raised()
             if name in codes and name not in EXIT_OF_THE_CALLER and entry.group != codes[name]]
    assert wrong == []


def test_each_entry_is_used():
    used = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            if path.name != "messages.py":
                used |= set(re.findall(r"MessageCode\.([A-Z_]+)\b", path.read_text(encoding="utf-8")))
    assert sorted({entry.name for entry in MessageCode} - used) == []


def test_a_coded_text_is_a_text_that_keeps_its_code():
    text = CodedText("one mean speed", MessageCode.ONE_MEAN_SPEED)
    assert text == "one mean speed" and json.dumps([text]) == '["one mean speed"]'
    for other in (pickle.loads(pickle.dumps(text)), copy.deepcopy(text)):
        assert entry_of(other, MessageCode.RESULT_WARNING) is MessageCode.ONE_MEAN_SPEED
    assert entry_of("plain", MessageCode.RESULT_WARNING) is MessageCode.RESULT_WARNING


@pytest.mark.parametrize("typed", ["TDH-412", "tdh-412", "tdh412", "412"])
def test_explain_shows_an_entry(typed, capsys):
    assert main(["explain", typed]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"TDH-412  {MessageCode.SHAFT_TURNS.title}\n")
    assert all(len(line) <= 80 for line in shown.splitlines())


def test_explain_lists_all_and_corrects_a_mistyped_code(capsys):
    assert main(["explain"]) == 0
    listed = capsys.readouterr().out
    assert all(entry.code in listed for entry in MessageCode)
    assert main(["explain", "TDH-4120"]) == 2
    assert " or TDH-412" in capsys.readouterr().err
    assert main(["explain", "TDH-412", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["code"] == "TDH-412"


def test_the_page_is_made_from_the_code():
    """The command that makes it is: tdhil explain --markdown > docs/reference/messages.md ."""
    assert (ROOT / "docs" / "reference" / "messages.md").read_text(encoding="utf-8") == page()


def test_an_error_shows_its_code_on_stderr_and_in_json(capsys):
    assert main(["identify", "--simulat", "--json"]) == 2
    shown = capsys.readouterr()
    assert shown.err.endswith("[TDH-202]\n") and "Did you mean '--simulate'?" in shown.err
    assert json.loads(shown.out)["error"]["code"] == "TDH-202"


def test_other_errors_have_a_code_too():
    assert code_of(KeyboardInterrupt()) == "TDH-1300"
    assert code_of(ValueError()) == "TDH-100"
    assert code_of(OSError(28, "No space left")) == "TDH-102"
    assert code_of(LogError("x")) == "TDH-107"
    assert message_of("TDH-999") is None and message_of("x") is None
