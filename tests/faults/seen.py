"""Results of tests of the fault table, one JSON line each, in the file that TDHIL_FAULT_TABLE names."""

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Seen:
    """Recorder of the results of one test."""

    test: str

    def __call__(self, row, said, standstill_s=None, log="", code=None):
        """Record a result. ``standstill_s``: plant time from the fault to the last movement of the true shaft."""
        path = os.environ.get("TDHIL_FAULT_TABLE")
        if not path:
            return
        said = re.sub(r"Virtual bus channel tdhil-[0-9a-f]+", "virtual bus", said)
        said = re.sub(r"\bec[0-9]+h[0-9]+\b", "eth1", said)       # its own pair of interfaces
        line = {"row": row, "test": self.test, "said": said, "standstill_s": standstill_s, "log": log, "code": code}
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")
