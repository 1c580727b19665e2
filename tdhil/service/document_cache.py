"""Cache of documents computed from ended runs: the same request gets the same document."""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from tdhil.service.store import LOG

MOST: Final = 64
"""Largest number of cached documents; a comparison of eight runs has about 100 kB."""


class DocumentCache:
    """Cache of the latest plans, trends, comparisons and calibrations. Each depends on its request and files only."""

    def __init__(self, runs: Path) -> None:
        self._runs = runs
        self._kept: OrderedDict[str, dict[str, Any]] = OrderedDict()

    def key(self, what: str, asked: Mapping[str, Any]) -> str | None:
        """Return the cache key of a request, its logs and its rig file; None if its document is not cached."""
        if what not in ("trend", "compare", "plan", "calibrate"):
            return None
        runs: Sequence[str] = asked["runs"] if what == "compare" else [
            asked[name] for name in ("without", "with_body") if name in asked]
        try:
            files = [hashlib.sha256(Path(asked["rig_file"]).read_bytes()).hexdigest()] if what == "plan" else []
            logs = [(one.st_size, one.st_mtime_ns) for one in ((self._runs / run / LOG).stat() for run in runs)]
        except OSError:
            return None
        return json.dumps([what, asked, logs, files], sort_keys=True)

    def get(self, key: str | None) -> dict[str, Any] | None:
        """Return a cached document and mark it as used last; None if it is not cached."""
        if key is None or key not in self._kept:
            return None
        self._kept.move_to_end(key)
        return self._kept[key]

    def put(self, key: str | None, document: dict[str, Any]) -> None:
        """Add a document to the cache. Above `MOST` documents, the least recently used one is removed."""
        if key is not None:
            self._kept[key] = document
            while len(self._kept) > MOST:
                self._kept.popitem(last=False)
