"""`tdhil explain`: cause and cure of a message, by its code."""

from __future__ import annotations

import argparse
import difflib
import json
import textwrap
from typing import Final

from profiles import MessageCode, message_of
from tdhil.cli.arguments import add_option
from tdhil.config import OPTION
from tdhil.errors import UsageError

GROUPS: Final = {
    0: ("Results", "0", "A result with a number, and the warnings beside it."),
    1: ("Internal errors", "1", "A defect of tdhil, or too little memory, disk space or processes."),
    2: ("Use, files and configuration", "2", "The command, a file or a setting has an error."),
    3: ("Partial results", "3", "The log, the output or the audit is incomplete. The recorded part is usable."),
    4: ("Refused before motion", "4", "A check before motion failed, and the run did not start."),
    5: ("Communication", "5", "The connection to the drive, the bus or a server failed."),
    6: ("Drive", "6", "The drive reported a fault, or its signals contradict each other."),
    7: ("Limits", "7", "A limit was reached in motion, and tdhil stopped the shaft."),
    8: ("Stop not confirmed", "8", "The shaft may still turn. Use the hard-wired emergency stop."),
    9: ("Not identifiable", "9", "The data do not determine the inertia, or contradict the model."),
    10: ("Unreadable files", "10", "A file contains no usable data."),
    11: ("Tuning refused", "11", "The requested gains are not recommended."),
    12: ("Not passed", "12", "A rehearsal, an acceptance or an archive of evidence failed its check."),
    13: ("Interrupted", "130 and above", "Ctrl-C or another signal ended the program."),
}
"""Title, exit code and one sentence of each group of codes."""

_HEAD: Final = """# Messages

Each error, refusal, verdict and warning of tdhil has a code that stays the same in all versions. The code follows
the text in brackets. In JSON and in the API it has the key `code`. `tdhil explain TDH-412` shows its cause and cure
offline.

The hundreds of a code are the exit code of the process; TDH-1300 ends with 130 or more. If standstill was not
confirmed, TDH-800 follows the first message, and the exit code is 8. This page is made from the code by
`tdhil explain --markdown`.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `tdhil explain`."""
    parser.add_argument("code", nargs="?", metavar="TDH-nnn", help="a code, such as TDH-412 (default: list all)")
    add_option(parser, OPTION["json"])
    parser.add_argument("--markdown", action="store_true", help="print the page docs/reference/messages.md")
    parser.set_defaults(run=run)


def run(namespace: argparse.Namespace) -> int:
    """Print one entry or the list. Raises UsageError for an unknown code, with the nearest known one."""
    wanted = list(MessageCode) if namespace.code is None else [_entry(namespace.code)]
    if namespace.markdown:
        print(page(), end="")  # noqa: T201
    elif namespace.json:
        documents = [document(entry) for entry in wanted]
        shown = documents if namespace.code is None else documents[0]
        print(json.dumps(shown, ensure_ascii=False, indent=2))  # noqa: T201
    elif namespace.code is None:
        rows = []
        for group, (title, code, _) in GROUPS.items():
            rows.append(f"\n{title} (exit code {code})")
            rows += [f"  {entry.code:<9} {entry.title}" for entry in MessageCode if entry.group == group]
        print("\n".join(rows).lstrip("\n"))  # noqa: T201
    else:
        print(text(wanted[0]))  # noqa: T201
    return 0


def document(entry: MessageCode) -> dict[str, str]:
    """Return an entry for JSON."""
    return {"code": entry.code, "title": entry.title, "cause": entry.cause, "cure": entry.cure,
            "exit_code": GROUPS[entry.group][1]}


def text(entry: MessageCode) -> str:
    """Return an entry for a terminal of 80 columns."""
    title, code, _ = GROUPS[entry.group]
    rows = [f"{entry.code}  {entry.title}", ""]
    for name, sentences in (("cause", entry.cause), ("cure", entry.cure), ("exit code", f"{code} ({title.lower()})")):
        rows.append(textwrap.fill(sentences, 79, initial_indent=f"{name:<11}", subsequent_indent=" " * 11,
                                  break_on_hyphens=False))      # options are not split
    return "\n".join(rows)


def page() -> str:
    """Return docs/reference/messages.md."""
    parts = [_HEAD]
    for group, (title, code, sentence) in GROUPS.items():
        parts.append(f"\n## {title}\n\nExit code {code}. {sentence}\n")
        parts += [f"\n### {entry.code} {entry.title}\n\n{entry.cause}\n\n*Cure:* {entry.cure}\n"
                  for entry in MessageCode if entry.group == group]
    return "".join(parts)


def _entry(code: str) -> MessageCode:
    entry = message_of(code)
    if entry is not None:
        return entry
    close = difflib.get_close_matches(code[:40].upper(), [one.code for one in MessageCode], n=3)
    hint = f"Did you mean {' or '.join(close)}? " if close else ""
    raise UsageError(f"there is no message with the code '{code[:40]}'",
                     next_step=f"{hint}tdhil explain lists all codes", entry=MessageCode.NOT_FOUND)
