"""A text file in blocks of whole lines, whatever its encoding, in bounded memory.

UTF-8, UTF-16 and UTF-32 are known by their byte order mark; without one it is UTF-8 if the beginning decodes as that,
else Windows-1252, which holds Latin-1's letters. Line ends may be LF, CR LF or CR.
"""

import codecs
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tdhil.record.csv_errors import CsvUnusable

MAX_BYTES = 4 * 2**30
MAX_LINE = 64 * 1024      # characters; a table's line has some hundred
_BLOCK = 1 << 20          # characters
_HEAD = 64 * 1024
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),      # before UTF-16, whose mark it begins with
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_PACKED = {
    b"PK\x03\x04": "a spreadsheet (.xlsx) or a zip",
    b"\xd0\xcf\x11\xe0": "a spreadsheet (.xls)",
    b"\x1f\x8b": "a gzip",
}


@dataclass(frozen=True)
class Block:
    """Lines without their ends; ``first`` is the number of the first one, from 1."""

    first: int
    lines: list[str]


def encoding_of(path: Path) -> str:
    """The codec to read ``path`` with. CsvUnusable for what is empty, too large, packed, binary or unreadable."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except OSError as error:
        raise CsvUnusable(f"can't be read ({error.strerror or error})", where=str(path)) from error
    if not head:
        raise CsvUnusable("the file is empty", where=str(path))
    if size > MAX_BYTES:
        raise CsvUnusable(
            f"the file is larger than {MAX_BYTES >> 30} GiB", where=str(path),
            next_step="Export the stretch with the excitation alone",
        )
    for magic, what in _PACKED.items():
        if head.startswith(magic):
            raise CsvUnusable(f"this is {what} file, no text", where=str(path), next_step="Save the table as CSV")
    found = next((name for mark, name in _MARKS if head.startswith(mark)), None) or _unmarked(head)
    # A logger whose power failed leaves NULs behind its last line.
    text = codecs.getincrementaldecoder(found)(errors="replace").decode(head).rstrip("\0")
    odd = sum(sign < " " and sign not in "\t\n\r\f\v" for sign in text)
    if not text or "\0" in text[:1024] or odd > 0.05 * len(text):
        raise CsvUnusable(
            "this is neither text nor a run.mcap", where=str(path),
            next_step="Export the trace as CSV, in UTF-8 (UTF-16 needs its byte order mark)",
        )
    return found


def _unmarked(head: bytes) -> str:
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)     # incremental: the cut may go through a character
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def blocks(path: Path, encoding: str) -> Iterator[Block]:
    """The lines of the file, about a million characters at a time. CsvUnusable for a line beyond all measure."""
    first, rest = 1, ""
    try:
        with path.open("r", encoding=encoding, errors="replace", newline=None) as file:
            while chunk := file.read(_BLOCK):
                lines = (rest + chunk.replace("\0", "")).split("\n")
                rest = lines.pop()
                if max(map(len, lines), default=0) > MAX_LINE or len(rest) > MAX_LINE:
                    at = next(at for at, line in enumerate([*lines, rest], first) if len(line) > MAX_LINE)
                    raise CsvUnusable(
                        f"a line of more than {MAX_LINE} characters is none of a table", where=f"{path}:{at}",
                        next_step="Look at the file in an editor",
                    )
                if lines:
                    yield Block(first, lines)
                    first += len(lines)
    except OSError as error:
        raise CsvUnusable(f"can't be read ({error.strerror or error})", where=str(path)) from error
    except UnicodeError as error:
        raise CsvUnusable(f"can't be decoded as {encoding}", where=str(path)) from error
    if rest:
        yield Block(first, [rest])
