"""Kind of a file by its first bytes. A file of another kind is named in the message, before it is read as a log."""

from __future__ import annotations

from pathlib import Path

from tdhil.errors import MessageCode, UsageError

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of an MCAP file."""
_HEAD_BYTES = 65_536
LOG, RESULT, PAGE, PDF, YAML = "a log", "a result of tdhil", "an HTML page", "a PDF file", "a YAML file"


def begins_like_log(head: bytes) -> bool:
    """Return whether these are the first bytes of an MCAP file, also if they are only some of them."""
    return head.startswith(MAGIC[:5]) or (bool(head) and MAGIC.startswith(head))


def kind_of(path: Path) -> str:
    """Return the kind of a file, such as ``a result of tdhil``; '' if neither content nor ending shows it."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:                     # the reader of the file reports it
        return ""
    if begins_like_log(head):
        return LOG
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith(b"{"):
        return RESULT if b'"tdhil"' in text else "a JSON file"
    if text.startswith((b"<!doctype html", b"<html")):
        return PAGE
    if text.startswith(b"%pdf"):
        return PDF
    return YAML if path.suffix.lower() in (".yaml", ".yml") else ""


def require_log_kind(path: Path, instead: str, *, trace: bool = False) -> None:
    """Raise UsageError if the file is of a kind that is neither a log nor a trace.

    ``instead``: what to give, for the next step. ``trace``: any other text may be a trace; otherwise only one that ends
    in .csv.
    """
    kind = kind_of(path)
    if kind == LOG or (not kind and (trace or path.suffix.lower() == ".csv")):
        return
    raise UsageError(f"is {kind}, not a log" if kind else "is not a log of tdhil (MCAP), and does not end in .csv",
                     where=str(path), next_step=f"Give the log: {instead}", entry=MessageCode.WRONG_KIND_OF_FILE)
