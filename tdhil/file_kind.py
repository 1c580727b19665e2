"""Kind of a file by its first bytes. A file of another kind is named in the message, before it is read as a log."""

from __future__ import annotations

from pathlib import Path

from tdhil.errors import MessageCode, UsageError

_MCAP = b"\x89MCAP0\r\n"
_HEAD_BYTES = 65_536
LOG, RESULT, PAGE, PDF = "a log", "a result of tdhil", "an HTML page", "a PDF file"


def kind_of(path: Path) -> str:
    """Return what the file is, such as ``a result of tdhil``; '' if neither content nor ending shows it."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:                     # the reader of the file reports it
        return ""
    if head.startswith(_MCAP[:5]) or (head and _MCAP.startswith(head)):
        return LOG
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith(b"{"):
        return RESULT if b'"tdhil"' in text else "a JSON file"
    if text.startswith((b"<!doctype html", b"<html")):
        return PAGE
    if text.startswith(b"%pdf"):
        return PDF
    return "a YAML file" if path.suffix.lower() in (".yaml", ".yml") else ""


def require_log_kind(path: Path, command: str, *, trace: bool = False) -> None:
    """Raise UsageError if the file is of a kind that is neither a log nor a trace.

    ``command``: in the next step. ``trace``: any other text may be a trace; otherwise only one that ends in .csv.
    """
    kind = kind_of(path)
    if kind == LOG or (not kind and (trace or path.suffix.lower() == ".csv")):
        return
    raise UsageError(f"is {kind}, not a log" if kind else "is not a log of tdhil (MCAP), and does not end in .csv",
                     where=str(path), next_step=f"Give the log: {command}", entry=MessageCode.WRONG_KIND_OF_FILE)
