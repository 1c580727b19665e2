"""Writes the reference pages that are made from code: ``python docs/made_pages.py``. A test fails if one is stale.

| page | made from |
|---|---|
| reference/command-line.md | the parsers of `tdhil.cli` |
| reference/candidates.md | the table of `tdhil.estimation.candidates` |
| reference/drives.md | the archives in `evidence/` |
| reference/figures.md | the table of `tdhil.report.figure_words` |
| reference/exit-codes.md | `tdhil.errors.ExitCode` and the tree of errors |
| reference/http-api.md | the OpenAPI document of `tdhil serve` |
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
REFERENCE = ROOT / "docs" / "reference"
MADE = "<!-- Made by python docs/made_pages.py. Change the code, not this page. -->\n\n"

_OF_PYTHON_CAN = {"interface", "channel", "bitrate", "fd", "data_bitrate", "timing", "bus_kwargs"}
_MOST_CHOICES = 12


# ---------------------------------------------------------------------------------------------------------------------
# The command line


def command_line() -> str:
    """The page of all commands and their options."""
    from tdhil.cli.main import build_parser

    out = [
        MADE + "# Command line",
        "",
        "`tdhil COMMAND --help` shows the options at the terminal. If a command has many, `--help-all` shows all of "
        "them. `tdhil --version` shows the version.",
        "",
        "Options must be written out in full. Values may have a unit: `--tolerance 1%`, "
        "`--max-time 5min`, `--amplitude 20rpm`.",
        "",
    ]
    names = _commands(build_parser(None))
    out += [
        "| command | |",
        "|---|---|",
        *(f"| [`tdhil {name}`](#tdhil-{name}) | {_cell(about)} |" for name, about in names.items()),
        "",
    ]
    for name, about in names.items():
        out += _command(f"tdhil {name}", _choices(build_parser(name))[name], _sentence(about), 2)
    return "\n".join(out).rstrip() + "\n"


def _commands(parser: argparse.ArgumentParser) -> dict[str, str]:
    (action,) = (one for one in parser._actions if isinstance(one, argparse._SubParsersAction))
    return {one.dest: one.help or "" for one in action._choices_actions}


def _choices(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def _command(title: str, parser: argparse.ArgumentParser, about: str, level: int) -> Iterator[str]:
    yield from (f"{'#' * level} {title}", "", about, "")
    python_can = False
    of_python_can = _OF_PYTHON_CAN if any(one.dest == "bus_kwargs" for one in parser._actions) else frozenset[str]()
    for group in parser._action_groups:
        shown = [
            one
            for one in group._group_actions
            if one.help != argparse.SUPPRESS and not isinstance(one, argparse._HelpAction | argparse._SubParsersAction)
        ]
        python_can |= any(one.dest in of_python_can for one in shown)
        shown = [one for one in shown if one.dest not in of_python_can]
        if shown:
            heading = {"options": "option", "positional arguments": "argument"}.get(group.title or "", group.title)
            yield from (
                f"| {_cell(heading or 'option')} | meaning |",
                "|---|---|",
                *(f"| {_usage(one)} | {_meaning(one, parser)} |" for one in shown),
                "",
            )
    if python_can:
        yield from (
            "Bus options of python-can: `-i`, `-c`, `-b`, `--fd`, `--data-bitrate`, `--timing`, "
            "`--bus-kwargs`, as `tdhil scan --help-all` shows them.",
            "",
        )
    for name, sub in _choices(parser).items():
        text = _commands(parser).get(name) or sub.description or ""
        yield from _command(f"{title} {name}", sub, _sentence(text), level + 1)


def _usage(action: argparse.Action) -> str:
    value = action.metavar if isinstance(action.metavar, str) else action.dest.upper()
    if not action.option_strings:
        return f"`{value if isinstance(action.metavar, str) else action.dest}`"
    takes = "" if action.nargs == 0 else f" {value}"
    if action.choices is not None and action.metavar is None:
        takes = " NAME"
    return ", ".join(f"`{flag}{takes if flag == action.option_strings[-1] else ''}`" for flag in action.option_strings)


def _meaning(action: argparse.Action, parser: argparse.ArgumentParser) -> str:
    text = _cell(parser._get_formatter()._expand_help(action)) if action.help else ""
    if action.choices is not None and len(list(action.choices)) <= _MOST_CHOICES:
        named = ", ".join(f"`{one}`" for one in action.choices)
        text = f"{text}: {named}" if text else named
    return text


def _cell(text: str) -> str:
    """Text for a cell of a table: in one line; what looks like HTML or like another cell is escaped."""
    return re.sub(r"\s+", " ", text).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*").strip()


def _sentence(text: str) -> str:
    text = _cell(text)
    return text if not text or text[-1] in ".?" else f"{text[0].upper()}{text[1:]}."


# ---------------------------------------------------------------------------------------------------------------------
# Candidates of the identification


def candidates() -> str:
    """The page of the models that are tried for J, a part for each walk."""
    from tdhil.estimation.candidates import FitRoute, rows

    out = [
        MADE + "# Candidates of the identification",
        "",
        "tdhil tries these models for J, from the first row to the last. A row is tried where it applies to the answer "
        "so far. [Models](../explanation/models.md) states the rule of selection and the rule of the interval.",
        "",
    ]
    for route in FitRoute:
        out += [f"## {route.value[0].upper()}{route.value[1:]}", ""]
        for row in rows(route):
            out += [
                f"### {row.name[0].upper()}{row.name[1:]}",
                "",
                "| | |",
                "|---|---|",
                f"| model | {_cell(row.model)} |",
                f"| data | {_cell(row.data)} |",
                f"| prior knowledge | {_cell(row.prior)} |",
                f"| tried | {_cell(row.tried)} |",
                f"| stands | {_cell(row.stands)} |",
                f"| interval of J | {_cell(row.interval)} |",
                f"| reason | {_cell(row.reason)} |",
                f"| test | `{row.test}` |",
                "",
            ]
    return "\n".join(out).rstrip() + "\n"


# ---------------------------------------------------------------------------------------------------------------------
# Exit codes

MEANING = {
    0: ("a result", "Use it."),
    1: (
        "internal error, or a file that tdhil cannot use",
        "Read the message. For TDH-100 and TDH-101 send the archive of `tdhil support`.",
    ),
    2: ("wrong use, or a mistake in a file", "Correct the option, or the line of the file, that the message names."),
    3: (
        "partial result: the log is incomplete, or the log or standard output broke off",
        "Look at what is missing. Make room on the disk.",
    ),
    4: (
        "refused before the motion of the run, or by a check that turns the shaft: sign of the torque, unit of the "
        "speed, braking, plan of stage 5",
        "Do what the message says. The last line states whether the shaft moved and is at standstill.",
    ),
    5: (
        "communication lost",
        "If the shaft turns, use the hard-wired emergency stop. Check cable, termination, supply and the load of the "
        "computer.",
    ),
    6: (
        "drive fault, or reports of the drive that contradict each other; standstill was confirmed",
        "Read the fault in the message and in the drive's manual.",
    ),
    7: (
        "a limit was exceeded, or leaves no room for the excitation; standstill was confirmed",
        "Lower the amplitude, or change the limit that the message names.",
    ),
    8: ("**the stop is not confirmed**", "**Use the hard-wired emergency stop.**"),
    9: (
        "`not_identifiable` or `model_rejected`; `tdhil evaluate`: no critical speed, or not that of the string; "
        "`tdhil severity`: the record does not show the torsional motion of the string",
        "`not_identifiable`: run the motion that the card names. `model_rejected`: look at the graphs, and repeat the "
        "run.",
    ),
    10: (
        "nothing can be recovered from a log, or nothing can be used of a trace",
        "Look for another copy of the file.",
    ),
    11: (
        "`tdhil tune`: no gains keep the margins, or the requested ones would oscillate",
        "Follow the message: request other values, or identify again for narrower intervals.",
    ),
    12: (
        "a rehearsed fault (`--fault`) did not cause the reaction that the fault table requires, or an identified "
        "value contradicts its expected one (`acceptance:`, `--expect`); `tdhil tune verify`: the drive does not step "
        "as tuned; `tdhil evidence --check`: the archive does not pass",
        "Compare what was required with what was seen. Both are on the card, and in `rehearsal` and `acceptance` of "
        "the document.",
    ),
    130: ("interrupted by Ctrl-C; a run has confirmed standstill", "Replay the log: what came before counts."),
    143: (
        "ended by SIGTERM, SIGHUP, SIGQUIT (Ctrl-\\\\) or SIGTSTP (Ctrl-Z); a run has confirmed standstill",
        "Replay the log: what came before counts.",
    ),
}
"""Exit code → what it means, what to do."""


def figures() -> str:
    """The page of the figures of tune soft-torque, severity and evaluate."""
    from tdhil.report.figure_words import FIGURES

    rows = (f"| {_cell(', '.join((one.name, *one.also)))} | {_cell(one.words)} |" for one in FIGURES)
    out = [MADE + "# Figures of soft torque", "",
           "The cards and pages of `tdhil tune soft-torque`, `severity` and `evaluate` show these figures.",
           "[Soft torque](../explanation/soft-torque.md) describes how they are computed.", "",
           "| figure | meaning |", "|---|---|", *rows]
    return "\n".join(out) + "\n"


def exit_codes() -> str:
    """The page of the exit codes, with the errors that end with each."""
    from tdhil.errors import ExitCode

    rows = [f"| {int(code)} | {MEANING[code][0]} | {MEANING[code][1]} |" for code in ExitCode]
    return (
        MADE
        + "\n".join(
            [
                "# Exit codes",
                "",
                "The exit code of the process states how a command ended. With `--json`, the document of an error has "
                "it as `exit_code`.",
                "",
                "| exit | meaning | what to do |",
                "|---|---|---|",
                *rows,
                "",
                "128 + n means that another signal n ended the run, after confirmed standstill.",
                "",
                "A message has three parts: what happened, with "
                "value and limit; what tdhil did; what to do next. The classes of errors are listed under "
                "[errors](python/errors.md).",
            ]
        )
        + "\n"
    )


# ---------------------------------------------------------------------------------------------------------------------
# The HTTP API


HTTP_HEAD = r"""
Everything is JSON. A run is requested with the options of `tdhil identify` as an object:

```sh
curl -X POST -H 'Content-Type: application/json' -H 'Idempotency-Key: 1' \
    -d '{"seed": 7, "tolerance": "1%"}' \
    http://127.0.0.1:8420/api/v1/rigs/simulated-canopen/runs
```

```python
import tdhil

service = tdhil.Client("http://127.0.0.1:8420")
run = service.start("simulated-canopen", seed=7)
found = service.wait(run["id"])
found["result"]["inertia_kg_m2"]
```

The body of an error has the keys of the [errors](python/errors.md): `kind`, `message`, `what`, `where`, `next_step`,
`exit_code`. An unknown key in a request is refused and named.

| status | meaning |
|---|---|
| 405 | the address does not take this method; `Allow` lists those that it takes |
| 409 | another process holds the drive; the body names the `holder` |
| 408, to an upload | the upload is too slow |
| 413 | the uploaded file is larger than the limit |
| 429 | too many requests; `Retry-After` says when to try again |
| 504, to a stop | the process of the run does not respond; the body says what the service does |
| 507 | the disk is full; no run starts |

`WS /api/v1/live/<run>` sends a run from its start: `hello`, then `news` with samples (thinned to 25 a second), events,
stages and the state of the run. `/metrics` is for Prometheus.
"""


def http_api() -> str:
    """The page of the HTTP API, from its OpenAPI document."""
    from tdhil.service.schemas import document

    found = document()
    out = [
        MADE + "# HTTP API",
        "",
        "`tdhil serve` has this API. `/api/v1/openapi.json` is the same as an OpenAPI "
        "document, with the schema of each body. [Run the service](../how-to/run-the-service.md) explains roles, "
        "codes and limits.",
        "",
        HTTP_HEAD.strip(),
        "",
        "## Addresses",
        "",
    ]
    for path, methods in found["paths"].items():
        for method, one in methods.items():
            out += [
                f"### {method.upper()} {path}",
                "",
                _sentence(one.get("summary") or one.get("description") or ""),
                "",
            ]
            out += [f"Role: {one['x-role']}.", ""] if "x-role" in one else []
            out += list(_parameters(one))
            answers: dict[str, list[str]] = {}
            for code, answer in one.get("responses", {}).items():
                answers.setdefault(_cell(answer.get("description", "")) + _schema(answer), []).append(code)
            out += [
                "| response | |",
                "|---|---|",
                *(f"| {', '.join(codes)} | {text} |" for text, codes in answers.items()),
                "",
            ]
    return "\n".join(out).rstrip() + "\n"


def _parameters(one: dict[str, Any]) -> Iterator[str]:
    rows = [
        f"| `{each['name']}` | {each['in']} | {_cell(each.get('description', ''))} |"
        for each in one.get("parameters", ())
    ]
    if rows:
        yield from ("| parameter | in | meaning |", "|---|---|---|", *rows, "")


def _schema(answer: dict[str, Any]) -> str:
    for media, body in answer.get("content", {}).items():
        name = body.get("schema", {}).get("$ref", "").rpartition("/")[2]
        return f" (`{name}`)" if name else f" ({media})" if media != "application/json" else ""
    return ""


# ---------------------------------------------------------------------------------------------------------------------
# Drives with evidence

EVIDENCE = ROOT / "evidence"
DRIVES_HEAD = """
Each row is an archive of one run in the folder `evidence/` of the repository. A test checks each archive, and
identifies J again from its log. [Publish evidence](../how-to/publish-evidence.md) describes how an archive is made
and sent.

* **En** compares J with the reference inertia: the difference over the expanded uncertainty of both (ISO 13528).
  At most 1 means that they agree.
* **Shown** names the entries of the profile whose effect the run showed. Such an entry may have the confidence
  *verified*, with the archive as its `source`. A test refuses an entry that names an archive which does not show it.
* The archive shows what its publisher recorded and stated. It does not show who made the run.
"""


def drives() -> str:
    """The page of the drives of which there is evidence, and of the example."""
    import json

    from profiles.library import load_profile, profile_names
    from tdhil.evidence import agreement_of, covered_entries, members_in, statement_in

    real, simulated = [], []
    for path in sorted(EVIDENCE.glob("*.zip")):
        members = members_in(path.read_bytes())
        identity, profile, result, manifest = (
            json.loads(members[name]) for name in ("identity.json", "profile.json", "result.json", "manifest.json"))
        statement = statement_in(json.loads(members["statement.json"]))
        name = profile["name"]
        today = load_profile(name).model_dump(mode="json", by_alias=True) if name in profile_names() else None
        covered = covered_entries(profile, manifest["shown"], today)
        found, inertia, reference = agreement_of(statement, result), result["inertia_kg_m2"], statement.reference
        row = (
            f"`{path.name}`",
            f"{identity['name']}, revision {identity['revision']:X}h" + (
                f", firmware {statement.firmware}" if statement.firmware else ""),
            f"`{name}`",
            "none" if inertia is None else
            f"{inertia['value']:.4g} ({inertia['low_total']:.4g} to {inertia['high_total']:.4g})",
            "none" if reference is None else
            f"{reference.inertia_kg_m2:.4g} ± {reference.sd_kg_m2:.2g} (1 sd), {reference.method}: {reference.note}",
            "–" if found is None else f"{found.score:.2f}",
            ", ".join(f"`{one}`: {why}" for one, why in covered.items()) or "none",
            statement.publisher,
        )
        (simulated if manifest["simulated"] else real).append(" | ".join(_cell(one) for one in row))
    head = ["| archive | drive | profile | J at the motor, kg·m² (95 %) | reference, kg·m² | En | shown | publisher |",
            "|---|---|---|---|---|---|---|---|"]
    out = [MADE + "# Drives with evidence", "", DRIVES_HEAD.strip(), "", "## Real drives", ""]
    out += [*head, *(f"| {row} |" for row in real)] if real else ["No archive of a real drive has been received yet."]
    out += ["", "## SIMULATED: the example", "",
            "This archive is of the simulated drive. It shows the form of an archive, and nothing about a drive.", "",
            *head, *(f"| {row} |" for row in simulated)]
    return "\n".join(out).rstrip() + "\n"


PAGES = {"candidates.md": candidates, "command-line.md": command_line, "drives.md": drives, "exit-codes.md": exit_codes,
         "figures.md": figures, "http-api.md": http_api}

if __name__ == "__main__":
    for name, make in PAGES.items():
        (REFERENCE / name).write_text(make(), encoding="utf-8")
        print(f"docs/reference/{name}")
