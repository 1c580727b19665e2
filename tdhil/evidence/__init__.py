"""Evidence from physical drives: one archive of a run that others can check, without data of a person or a site."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.evidence.archive import MEMBERS as MEMBERS, archive_of as archive_of, members_in as members_in
    from tdhil.evidence.drives import (
        Agreement as Agreement, agreement_of as agreement_of, covered_entries as covered_entries,
        entries_of as entries_of, shown_entries as shown_entries,
    )
    from tdhil.evidence.making import (
        EvidenceArchive as EvidenceArchive, EvidenceCheck as EvidenceCheck, check_evidence as check_evidence,
        make_evidence as make_evidence,
    )
    from tdhil.evidence.scrub import Scrub as Scrub, names_of_this_computer as names_of_this_computer
    from tdhil.evidence.statement import (
        NEEDED as NEEDED, SHORTEST_KEY as SHORTEST_KEY, PublisherStatement as PublisherStatement, flag_of as flag_of,
        serial_hmac as serial_hmac, statement_in as statement_in, statement_of as statement_of, wrong_in as wrong_in,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "archive": "MEMBERS archive_of members_in",
        "drives": "Agreement agreement_of covered_entries entries_of shown_entries",
        "making": "EvidenceArchive EvidenceCheck check_evidence make_evidence",
        "scrub": "Scrub names_of_this_computer",
        "statement": "NEEDED SHORTEST_KEY PublisherStatement flag_of serial_hmac statement_in statement_of wrong_in",
    })
