"""One call of tdhil's command line in this process: what it printed, how it ended, and the processor time it took."""

from __future__ import annotations

import contextlib
import io
import json
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Called:
    """Exit code, what ``--json`` printed ({} if nothing), stderr, and the processor time, s."""

    code: int
    document: dict[str, Any]
    said: str
    took_s: float


def called_here(arguments: Sequence[str]) -> Called:
    """Never raises: a mistake of tdhil's own is exit code 1, with its traceback in ``said``."""
    from tdhil.cli.main import main as tdhil

    out, err = io.StringIO(), io.StringIO()
    began_s = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = tdhil(list(arguments))
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
        except Exception:
            code = 1
            traceback.print_exc()
    took_s = time.process_time() - began_s
    printed = out.getvalue()
    return Called(code, json.loads(printed) if printed.strip() else {}, err.getvalue(), took_s)
