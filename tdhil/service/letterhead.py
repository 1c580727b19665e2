"""Letterhead of the reports of this service: file letterhead.json in its folder, changed by an admin."""

from __future__ import annotations

import hashlib
from base64 import b64decode
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from tdhil.errors import LogError, UsageError
from tdhil.fleet import ANNOTATIONS_FILE
from tdhil.report import LONGEST_LINE, MOST_LINES, NO_LETTERHEAD, Letterhead, clean_logo
from tdhil.service.annotations import Annotations, one_line
from tdhil.service.audit import Audit
from tdhil.service.start_request import require_right
from tdhil.service.store import Store, read_json, write_json

FILE: Final = "letterhead.json"
"""File in the folder of the service."""


def stored_letterhead(folder: Path) -> Letterhead:
    """Return the letterhead in the folder of a service; an empty one if there is none, or it can't be read."""
    with suppress(UsageError, ValueError, TypeError):
        return Letterhead.of_plain(read_json(folder / FILE) or {})
    return NO_LETTERHEAD


def change_letterhead(
    store: Store, audit: Audit, who: str, *, company: str, address: Sequence[str], logo: str | None
) -> Letterhead:
    """Write the letterhead, and before it the audit. ``logo``: a PNG in base64, '' for none, None for the present one.

    Raises ValuesWrong with all wrong values, and LogError if audit or file can't be written: nothing has changed then.
    """
    company, lines = one_line(company), tuple(filter(None, map(one_line, address)))
    wrong = []
    if len(company) > LONGEST_LINE:
        wrong.append(("company", f"must be a text of at most {LONGEST_LINE} characters"))
    if len(lines) > MOST_LINES or any(len(line) > LONGEST_LINE for line in lines):
        wrong.append(("address", f"must be at most {MOST_LINES} lines of at most {LONGEST_LINE} characters"))
    picture = stored_letterhead(store.folder).logo if logo is None else b""
    if logo:
        try:
            picture = clean_logo(b64decode(logo, validate=True))
        except UsageError as error:
            wrong.append(("logo", f"{error.what}. {error.next_step}"))
        except ValueError:
            wrong.append(("logo", "must be a PNG in base64"))
    require_right(wrong)
    found = Letterhead(company, lines, picture)
    try:
        audit.note(who, "letterhead changed", run=None, rig=None, company=company, address=list(lines),
                   logo_sha256=hashlib.sha256(picture).hexdigest() if picture else "")
        write_json(store.folder / FILE, found.plain())
    except OSError as error:
        raise LogError(f"the letterhead can't be written ({error.strerror or error})", where="letterhead",
                       next_step="Nothing was changed. Free some disk space, or check the folder"
                       " of the service") from error
    return found


def outdated_reports(folder: Path, signature: str, annotations: Annotations) -> list[str]:
    """Return the reports in the folder of a run that are older than what they show beside the result.

    This is the signature (file name ``signature``), an edited text, and the letterhead of the service.
    """
    sources = [folder / signature, folder.parent.parent / FILE]
    if annotations.text_edits:
        sources.append(folder / ANNOTATIONS_FILE)
    newest = max((one.stat().st_mtime_ns for one in sources if one.is_file()), default=0)
    return [name for name in REPORTS if (made := folder / name).is_file() and made.stat().st_mtime_ns <= newest]


REPORTS: Final = ("report.html", "report.pdf")
