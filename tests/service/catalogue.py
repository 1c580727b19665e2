"""Texts of the service's pages, and the catalogues that translate them.

``python -m tests.service.catalogue`` brings each catalogue up to date: a new text gets an empty entry, and a text that
no page has any more is removed. Translations stay. ``--check`` changes nothing; it lists what is missing, and says if
a catalogue is not up to date.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from jinja2 import Environment, nodes

from tdhil.service.languages import BETWEEN, FOLDER, entries
from tests.service.javascript import literals

ROOT = Path(__file__).parents[2]
SERVICE = ROOT / "tdhil" / "service"
SCRIPTS = sorted(one for one in (SERVICE / "static").glob("*.js") if not one.name.startswith("uPlot"))
TEMPLATES = sorted((SERVICE / "templates").glob("*.html"))
ELSEWHERE = {"client.py", "console.py", "mail.py", "mqtt.py", "server.py", "webhook.py", "password_file.py", "audit.py"}
"""Modules of the service whose errors no page shows, since they belong to the terminal."""
_ERRORS = re.compile(r"(Error|Refused|ValuesWrong|NotAllowed|Conflict|NotThere|NoRoom|TooLarge|TooSlow|NotLoggedIn"
                     r"|TooManyTries|NotReacting|request_wrong|option_wrong|page_text)$")


class Text(NamedTuple):
    """One text of the pages: its place, its context in the catalogue, and the English text."""

    place: str
    context: str
    text: str

    @property
    def key(self) -> str:
        return f"{self.context}{BETWEEN}{self.text}" if self.context else self.text


def of_templates() -> Iterator[Text]:
    environment = Environment(trim_blocks=True, lstrip_blocks=True)
    for path in TEMPLATES:
        for call in environment.parse(path.read_text(encoding="utf-8")).find_all(nodes.Call):
            if isinstance(call.node, nodes.Name) and call.node.name == "_" and isinstance(call.args[0], nodes.Const):
                yield Text(str(path.relative_to(ROOT)), "", call.args[0].value)


def of_scripts() -> Iterator[Text]:
    for path in SCRIPTS:
        for one in literals(path.read_text(encoding="utf-8")):
            if one.before.endswith("tr("):
                assert not one.template, f"{path.name}:{one.line}: tr() takes a plain text, and values behind it"
                yield Text(str(path.relative_to(ROOT)), "", json.loads(f'"{one.text}"'))


def of_errors() -> Iterator[Text]:
    """Return the cause and the next step of each error of a service module; values are ``{0}``, ``{1}``."""
    for path in (*sorted(SERVICE.rglob("*.py")), ROOT / "profiles" / "quantities.py"):
        if path.name in ELSEWHERE:
            continue
        calls = (one for one in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(one, ast.Call))
        for call in sorted(calls, key=lambda one: (one.lineno, one.col_offset)):
            if not _ERRORS.search(ast.unparse(call.func)):
                continue
            fields = (pair.elts[1] for one in call.args[:1] for pair in ast.walk(one)
                      if isinstance(pair, ast.Tuple) and len(pair.elts) == 2)          # of ValuesWrong
            steps = (*call.args[2:3], *(one.value for one in call.keywords if one.arg == "next_step"))
            for node in (*call.args[:1], *fields, *steps):
                for part in (node.body, node.orelse) if isinstance(node, ast.IfExp) else (node,):
                    text = None if "dimension" in ast.unparse(part) else _pattern(part)      # its word is English
                    if text and re.search(r"[a-z]{2,} \S", re.sub(r"\{\d\}", "", text)):
                        yield Text(str(path.relative_to(ROOT)), "message", text)


def _pattern(node: ast.AST) -> str | None:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if not isinstance(node, ast.JoinedStr):
        return None
    found, count = "", 0
    for part in node.values:
        if isinstance(part, ast.Constant):
            found += str(part.value)
        else:
            found, count = f"{found}{{{count}}}", count + 1
    return found


def of_code() -> Iterator[Text]:
    """Return the texts that Python passes to a page."""
    for path in (SERVICE / "page_routes.py",):
        for text in re.findall(r'language\.text\("([^"]+)"', path.read_text(encoding="utf-8")):
            yield Text(str(path.relative_to(ROOT)), "", text)


def vocabulary() -> Iterator[Text]:
    """Return the words that the API sends and a page shows, from the tables that declare them."""
    from typing import get_args

    from drivers.drive import REACTIONS, Outcome
    from profiles import MessageCode
    from tdhil.config import form_options
    from tdhil.config.acceptance import ACCEPTED_QUANTITIES
    from tdhil.estimation import Verdict
    from tdhil.fleet.trend import QUANTITIES
    from tdhil.report import GRAPHS
    from tdhil.report.blocks import TORQUE_OVER_ANGLE, UNCERTAINTY_BUDGET
    from tdhil.runner import STAGES
    from tdhil.service.accounts import Role
    from tdhil.service.new_rig import new_rig_view
    from tdhil.service.page_routes import AS_RIG
    from tdhil.service.run_state import State
    from tdhil.service.start_request import LIMIT_TEXTS
    from tdhil.session.confirm import CHECKLIST

    options = "tdhil/config/options.py"
    forms = ("run", "acquire", "simulated", "real", "rehearsal", "replay", "trace", "upload", "motion", "motion-file",
             "evidence")
    for part in forms:
        for one in form_options(part):
            assert one.form is not None
            yield from (Text(options, "", label) for label in (one.form.label, *(label for _, label in one.form.ticks)))
            hint = one.form_hint.removeprefix(AS_RIG)
            if re.search(r"[A-Za-z]{2,}", hint) and hint not in (one.allowed or ()):
                yield Text(options, "", hint)
    for one in form_options("acquire"):
        yield Text(options, "", one.form_help)
    for text in LIMIT_TEXTS:
        yield Text("tdhil/service/start_request.py", "", text)
        holes = [one for one in ("low", "high") if f"{{{one}}}" in text]
        numbered = {name: f"{{{number}}}" for number, name in enumerate((*holes, "value"))}
        message = f"must be {text}, not {{value}}".format_map(numbered)
        yield Text("tdhil/service/start_request.py", "message", message)
    for role in get_args(Role):
        yield Text("tdhil/service/accounts.py", "role", role)
    for state in (*State, "waiting", "delayed"):
        yield Text("tdhil/service/run_state.py", "state", str(state))
    for stage in STAGES:
        yield Text("tdhil/runner/task.py", "stage", stage)
    for outcome in (Outcome.OK.value, "skipped", "aborted"):
        yield Text("tdhil/runner/task.py", "outcome", outcome)
    for verdict in (*(one.value for one in Verdict), "pass", "fail", "cannot tell", "inconclusive"):
        yield Text("tdhil/estimation/result.py", "verdict", verdict)
    for point in CHECKLIST:
        yield Text("tdhil/session/confirm.py", "check", point)
    for reaction in REACTIONS.values():
        yield Text("drivers/drive.py", "reaction", reaction)
    for mode in ("torque", "speed"):
        yield Text("tdhil/runner/design", "mode", mode)
    for how in ("hidden", "closed", "silent"):
        yield Text("tdhil/service/schemas.py", "page", how)
    for quantity in ("time", "speed", "torque"):
        yield Text("tdhil/recording/csv/layout.py", "quantity", quantity)
    for sign in ("comma", "semicolon", "tab", "point"):
        yield Text("tdhil/service/upload_work.py", "sign", sign)
    for field in ("operator", "note", "tags", "archived"):
        yield Text("tdhil/service/annotations.py", "field", field)
    for path in sorted((*(ROOT / "tdhil/estimation").rglob("*.py"), *(ROOT / "tdhil/calibration").rglob("*.py"))):
        for source in re.findall(r'(?:BudgetLine\(|^        \()"([a-z][^"]+)", (?!")', path.read_text("utf-8"), re.M):
            yield Text("tdhil/estimation", "budget", source)
    for accepted in ACCEPTED_QUANTITIES.values():
        yield Text("tdhil/config/acceptance.py", "", accepted.label)
    for followed in QUANTITIES:
        yield Text("tdhil/fleet/trend.py", "", followed.name)
    view = new_rig_view()
    for field_view in view.machine:
        yield Text("tdhil/config/rig.py", "", field_view.description)
    for profile in view.profiles:
        for key in profile.address:
            yield Text("tdhil/buses", "key", key.name.replace("_", " "))
            yield Text("tdhil/buses", "", key.description)
        for key in profile.parameters:
            yield Text("profiles", "", key.description)
    blocks = (ROOT / "tdhil/report/blocks.py").read_text(encoding="utf-8")
    for heading in (*re.findall(r'ReportSection\("([^"]+)"', blocks), UNCERTAINTY_BUDGET.capitalize(),
                    TORQUE_OVER_ANGLE.capitalize()):
        yield Text("tdhil/report/blocks.py", "", heading)
    for name in sorted(set(re.findall(r"graphs\.(\w+)\.reading", "".join(map(Path.read_text, TEMPLATES))))):
        yield Text("tdhil/report/graphs.py", "graph", GRAPHS[name].reading)
    for entry in MessageCode:
        yield Text("profiles/messages.py", entry.code, entry.title)


def texts() -> dict[str, list[Text]]:
    """Return each text of the pages by its key, with all of its places."""
    found: dict[str, list[Text]] = {}
    for one in (*of_templates(), *of_scripts(), *of_code(), *vocabulary(), *of_errors()):
        found.setdefault(one.key, []).append(one)
    return found


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def updated(text: str) -> str:
    """Return the text of a catalogue with exactly the texts of the pages."""
    head, *known = entries(text)
    kept = {f"{one['msgctxt']}{BETWEEN}{one['msgid']}" if "msgctxt" in one else one["msgid"]: one for one in known}
    rows = [row for row in (head.get("comment", ""),) if row]
    rows += ['msgid ""', 'msgstr ""', *(_quoted(f"{row}\n") for row in head["msgstr"].splitlines())]
    for key, where in texts().items():
        one = kept.get(key, {})
        rows += ["", *filter(None, (one.get("comment"),))]
        rows += [f"#: {place}" for place in dict.fromkeys(text.place for text in where)]
        rows += filter(None, (one.get("flags"),))
        rows += [f"msgctxt {_quoted(where[0].context)}"] if where[0].context else []
        rows += [f"msgid {_quoted(where[0].text)}", f"msgstr {_quoted(one.get('msgstr', ''))}"]
    return "\n".join(rows) + "\n"


def main(check: bool) -> int:
    """Bring the catalogues up to date. Return 1 if a text has no translation, or with ``check`` if one is not."""
    missing = 0
    for path in sorted(FOLDER.glob("*.po")):
        before = path.read_text(encoding="utf-8")
        text = updated(before)
        if not check:
            path.write_text(text, encoding="utf-8")
        elif text != before:
            missing += 1
            print(f"{path.name}: not up to date: run python -m tests.service.catalogue")
        empty = [one["msgid"] for one in entries(text)[1:] if not one["msgstr"] or "fuzzy" in one.get("flags", "")]
        missing += len(empty)
        print(f"{path.name}: {len(entries(text)) - 1} texts, {len(empty)} without a translation")
        print(*(f"  {one}" for one in empty), sep="\n")
    return min(missing, 1)


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv))
