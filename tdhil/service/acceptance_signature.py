"""Signature of a person under the acceptance of a run. Pure data, file acceptance_signed.json.

It is bound to the log by the log's SHA-256, and to the signed verdict with all its quantities by their SHA-256. The
signature itself is bound by its entry in the audit, which has all its fields.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

FILE: Final = "acceptance_signed.json"
SIGNED: Final = "acceptance signed"
"""Kind of the audit's entry of a signature. The details of the entry are the fields of the signature."""
LONGEST_NAME: Final = 200
"""Longest name of the person who signs, characters."""
LONGEST_REMARK: Final = 500
"""Longest remark of a signature, characters."""
_LABELS: Final = {"by": "account", "at": "time", "log_sha256": "SHA-256 of the log",
                  "acceptance_sha256": "SHA-256 of the acceptance"}
PASS: Final = "pass"
"""The verdict that is signed without a remark."""


@dataclass(frozen=True)
class AcceptanceSignature:
    """A signature. ``by``: the account, and ``role`` its role; ``name``: the person, as typed; ``at``: ISO 8601, UTC.

    ``acceptance_sha256``: hash of the signed verdict with its quantities.
    """

    name: str
    role: str
    by: str
    at: str
    remark: str
    verdict: str
    log_sha256: str
    acceptance_sha256: str

    def problem(self, acceptance: Mapping[str, Any] | None, log_sha256: str, audited: Mapping[str, Any] | None) -> str:
        """Return why the signature does not hold for this acceptance and this log, in words; '' if it does.

        ``audited``: details of the audit's last entry `SIGNED` of this run, None without one.
        """
        if log_sha256 != self.log_sha256:
            return "the log is not the signed one"
        if acceptance is None or hash_of(acceptance) != self.acceptance_sha256:
            return f"the acceptance is not the signed one, whose verdict was {self.verdict}"
        if acceptance.get("verdict") != self.verdict:
            return f"its verdict is {self.verdict}, and the verdict of the acceptance is {acceptance.get('verdict')}"
        if audited is None:
            return "the audit has no intact entry of a signature of this run"
        changed = [_LABELS.get(name, name) for name, value in asdict(self).items() if audited.get(name) != value]
        return f"it differs from its entry in the audit: {', '.join(changed)}" if changed else ""


def hash_of(acceptance: Mapping[str, Any]) -> str:
    """Return the SHA-256 of an acceptance, in hex. The order of its keys does not matter."""
    return hashlib.sha256(json.dumps(acceptance, sort_keys=True).encode()).hexdigest()
