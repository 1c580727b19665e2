"""Protection of stdout and stderr in any state: closed, full, or without '²'. No run and no result is lost by it."""

from __future__ import annotations

import codecs
import io
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast

from tdhil.errors import ExitCode, MessageCode, TdhilError

_PLAIN = {
    "·": ".", "²": "2", "³": "3", "¹": "1", "⁻": "-", "±": "+-", "×": "x", "°": "deg", "µ": "u", "μ": "u", "–": "-",
    "—": "-", "−": "-", "…": "...", "→": "->", "←": "<-", "↵": "", "≤": "<=", "≥": ">=", "≈": "~", "‰": "permille",
    "ω": "w", "α": "a", "τ": "tau", "σ": "sigma", "Ω": "Ohm", "Δ": "d", "π": "pi", "✓": "ok", "✗": "X", "▸": ">",
    "’": "'", "“": '"', "”": '"', "„": '"', "é": "e", "ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss",
}
_HANDLER = "tdhil"


class OutputLost(TdhilError):
    """Raised if stdout cannot be written: its disk is full, or the terminal is gone. The output went to stderr."""

    entry = MessageCode.OUTPUT_LOST

    exit_code = ExitCode.PARTIAL


class WatchedStream:
    """Stream with handling of write errors: stdout raises `OutputLost`, stderr ignores them."""

    def __init__(self, stream: TextIO, *, needed: bool) -> None:
        self._stream = stream
        self._needed = needed
        self._lost = False
        self.written = False

    def write(self, text: str) -> int:
        self.written = True
        if not self._lost:
            self._try(lambda: self._stream.write(_in_columns(text, self._stream.encoding)))
        return len(text)

    def flush(self) -> None:
        if not self._lost:
            self._try(self._stream.flush)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def _try(self, act: Callable[[], object]) -> None:
        try:
            act()
        except (OSError, ValueError) as error:
            self._lost = True
            gone = isinstance(error, BrokenPipeError)
            forget(self._stream)
            if self._needed and gone:
                raise
            if self._needed:
                reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
                step = "Free some space, or write elsewhere"
                raise OutputLost(f"can't be written: {reason}", where="stdout", next_step=step) from error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def sheltered() -> Iterator[None]:
    """Protect the streams before anything is opened or printed.

    Otherwise the next opened file, possibly the log, would get the number of a closed stdout or stderr. In stdout and
    stderr, a character that the stream cannot encode is replaced by a similar one.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)      # the lowest free number: that of this stream
    codecs.register_error(_HANDLER, _resembling)
    former = sys.stdout, sys.stderr
    err = sys.stderr if sys.stderr is not None else io.StringIO()
    for stream in (sys.stdout, err):
        if hasattr(stream, "reconfigure"):
            with suppress(OSError, ValueError):
                stream.reconfigure(errors=_HANDLER)
    sys.stderr = cast(TextIO, WatchedStream(err, needed=False))
    sys.stdout = cast(TextIO, WatchedStream(sys.stdout, needed=True)) if sys.stdout is not None else sys.stderr
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stdout, sys.stderr = former


def forget(stream: TextIO) -> None:
    """Discard buffered and later output of ``stream``."""
    with suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
    with suppress(OSError, ValueError):
        stream.flush()


def _in_columns(text: str, encoding: str | None) -> str:
    """Return ``text`` in characters of ``encoding``, with unchanged line widths if spaces allow it.

    '+-' for '±' would shift a table's right edge.
    """
    try:
        text.encode(encoding or "utf-8")
        return text
    except (UnicodeEncodeError, LookupError):
        pass
    lines = []
    for line in text.split("\n"):
        plain = line.encode(encoding or "ascii", _HANDLER).decode(encoding or "ascii")
        more = len(plain) - len(line)
        gaps = [gap for gap in re.finditer(" {2,}", plain) if len(gap[0]) > more]
        if more > 0 and gaps:
            plain = plain[:gaps[-1].start()] + plain[gaps[-1].start() + more:]
        lines.append(plain)
    return "\n".join(lines)


def _resembling(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start:error.end]
    known = "".join(_PLAIN.get(sign, "?") for sign in text)
    try:
        known.encode(error.encoding)
    except (UnicodeEncodeError, LookupError):
        known = "?" * len(text)
    return known, error.end
