"""Request for an archive of evidence of a run: the publisher's statement, and what is kept of the finished archive.

Pure data. The archive stands beside the log as evidence.zip, and evidence.json has its digest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from tdhil.config import OF_EVIDENCE, EvidenceOptions
from tdhil.errors import UsageError
from tdhil.service.run_state import request_wrong
from tdhil.service.start_request import require_right, value_of

ARCHIVE: Final = "evidence.zip"
ABOUT: Final = "evidence.json"
STATEMENT: Final = MappingProxyType({one.name: one for one in OF_EVIDENCE})
"""Options of the statement, by name."""


@dataclass(frozen=True)
class EvidenceView:
    """A finished archive. ``sha256``: of the archive, which signs it; ``publish``: the parts that may be published;
    ``by`` and ``at``: the account that requested it, and when (ISO 8601, UTC).
    """

    run: str
    sha256: str
    size_bytes: int
    publisher: str
    publish: list[str]
    simulated: bool
    by: str
    at: str


def stated_in(body: Mapping[str, Any]) -> EvidenceOptions:
    """Return the statement of a request. Raises ValuesWrong with all that is wrong or missing, and UsageError for an
    unknown key.
    """
    from tdhil.evidence import wrong_in

    given: dict[str, Any] = {}
    wrong: list[tuple[str, str]] = []
    for name, value in body.items():
        option = STATEMENT.get(str(name))
        if option is None:
            raise request_wrong("is not a part of the statement", str(name)[:60], f"Parts: {', '.join(STATEMENT)}")
        if value in (None, "", []):
            continue
        try:
            found = value_of(option, value)
        except UsageError as error:
            wrong.append((name, error.what))
            continue
        given[option.keyword] = tuple(found) if option.joined else found
    refused = {name for name, _ in wrong}
    wrong += [(name, why) for name, why in wrong_in(EvidenceOptions(**given)) if name not in refused]
    require_right(wrong)
    return EvidenceOptions(**given)
