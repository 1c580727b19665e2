"""What tests saw of the rows of the fault table, a JSON line each, where TDHIL_FAULT_TABLE names a file."""

import json
import os
import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Seen:
    """Of one test."""

    test: str

    def __call__(self, row, said, standstill_s=None, log="", code=None):
        """``standstill_s``: plant time from the fault to the last movement of the true shaft."""
        path = os.environ.get("TDHIL_FAULT_TABLE")
        if not path:
            return
        said = re.sub(r"Virtual bus channel tdhil-[0-9a-f]+", "virtual bus", said)
        said = re.sub(r"\bec[0-9]+h[0-9]+\b", "eth1", said)       # a pair of interfaces of its own
        line = {"row": row, "test": self.test, "said": said, "standstill_s": standstill_s, "log": log, "code": code}
        with Path(path).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")
