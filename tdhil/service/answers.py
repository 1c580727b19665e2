"""Documents that were computed from ended runs, kept in memory: the same question has the same answer."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

MOST: Final = 64
"""Documents that are kept; a comparison of eight runs is some 100 kB."""


class KeptAnswers:
    """The latest documents of `plan`, `trend` and `compare`. Each depends on its question and the files in it alone."""

    def __init__(self, runs: Path) -> None:
        self._runs = runs
        self._kept: OrderedDict[str, dict[str, Any]] = OrderedDict()

    def key(self, what: str, asked: Mapping[str, Any]) -> str | None:
        """Return the key of a question, with its logs and its rig file; None if its answer is not kept."""
        if what not in ("trend", "compare", "plan"):
            return None
        runs: Sequence[str] = asked["runs"] if what == "compare" else ()
        try:
            files = [hashlib.sha256(Path(asked["rig_file"]).read_bytes()).hexdigest()] if what == "plan" else []
            logs = [(one.st_size, one.st_mtime_ns) for one in ((self._runs / run / "run.mcap").stat() for run in runs)]
        except OSError:
            return None
        return json.dumps([what, asked, logs, files], sort_keys=True)

    def get(self, key: str | None) -> dict[str, Any] | None:
        """Return a kept document, and keep it longer."""
        if key is None or key not in self._kept:
            return None
        self._kept.move_to_end(key)
        return self._kept[key]

    def put(self, key: str | None, document: dict[str, Any]) -> None:
        """Keep a document; the oldest one is dropped."""
        if key is not None:
            self._kept[key] = document
            while len(self._kept) > MOST:
                self._kept.popitem(last=False)
