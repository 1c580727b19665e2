"""The publisher's statement in an archive of evidence: permission, and the reference inertia with its source."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from tdhil.config import OF_EVIDENCE, PUBLISHABLE, EvidenceOptions
from tdhil.evidence.leaks import leaks_in

PARTS: Final = tuple(name for name, _ in PUBLISHABLE)
"""Parts that a publisher may permit to publish."""
ALL: Final = "all"
NEEDED: Final = frozenset({"log", "result", "identity"})
"""Parts that an archive in the folder `evidence/` needs: this folder is public."""
SHORTEST_KEY: Final = 32
"""Shortest key for serial numbers, bytes: as long as the output of SHA-256 (RFC 2104, section 3)."""

_FLAG: Final = {one.name: one.flag for one in OF_EVIDENCE}
_REFERENCE: Final = ("reference_inertia_kg_m2", "reference_sd_kg_m2", "reference_method")


@dataclass(frozen=True)
class ReferenceInertia:
    """Inertia at the motor shaft from another source than the run. ``sd_kg_m2``: its standard uncertainty.

    ``method``: weighed, drawing, manufacturer or other; ``note``: the method in words.
    """

    inertia_kg_m2: float
    sd_kg_m2: float
    method: str
    note: str


@dataclass(frozen=True)
class PublisherStatement:
    """Statement of the publisher. ``publish``: the permitted parts; ``reference``: None if none is known.

    ``serial_hmac_sha256``: keyed hash of the drive's serial number, '' without a key.
    """

    publisher: str
    publish: tuple[str, ...]
    reference: ReferenceInertia | None
    firmware: str
    simulated: bool
    serial_hmac_sha256: str = ""

    def plain(self) -> dict[str, Any]:
        """Return plain data for statement.json."""
        return asdict(self) | {"publish": list(self.publish)}


def statement_in(plain: Any) -> PublisherStatement:
    """Return the statement in statement.json. Raises ValueError with the mistakes."""
    if not isinstance(plain, Mapping) or set(plain) != set(PublisherStatement.__dataclass_fields__):
        raise ValueError("statement.json has other entries than those of a statement")
    reference = plain["reference"]
    if reference is not None and (
            not isinstance(reference, Mapping) or set(reference) != set(ReferenceInertia.__dataclass_fields__)):
        raise ValueError("statement.json has other entries than those of a reference inertia")
    given = EvidenceOptions(
        publisher=plain["publisher"], publish=",".join(map(str, plain["publish"])), firmware=plain["firmware"],
        simulated=plain["simulated"] is True,
        **({} if reference is None else {f"reference_{name}": value for name, value in reference.items()}),
    )
    if wrong := wrong_in(given):
        raise ValueError("; ".join(f"{name} {why}" for name, why in wrong))
    return statement_of(given, serial_hmac_sha256=str(plain["serial_hmac_sha256"]))


def parts_in(text: str) -> tuple[str, ...]:
    """Return the parts in a text such as ``log,result``, in the order of `PARTS`. Raises ValueError."""
    asked = {one for one in text.replace(" ", ",").split(",") if one}
    if ALL in asked:
        return PARTS
    if unknown := sorted(asked - set(PARTS)):
        raise ValueError(f"{', '.join(unknown)[:60]}: the parts are {', '.join(PARTS)} and {ALL}")
    return tuple(one for one in PARTS if one in asked)


def wrong_in(given: EvidenceOptions) -> list[tuple[str, str]]:
    """Return every mistake and everything that is missing, as (name of the option, reason)."""
    wrong: list[tuple[str, str]] = []
    if not isinstance(given.publisher, str) or not given.publisher.strip():
        wrong.append(("publisher", "is missing: state the person or organisation that permits publication"))
    try:
        if not isinstance(given.publish, str) or not parts_in(given.publish):
            wrong.append(("publish", f"is missing: state the parts that may be published, of {', '.join(PARTS)}, or"
                                     f" {ALL}"))
    except ValueError as error:
        wrong.append(("publish", str(error)))
    stated = [name for name in _REFERENCE if getattr(given, name) is not None]
    if stated and len(stated) < len(_REFERENCE):
        wrong += [(name, "is missing: a reference inertia needs its value, its standard uncertainty and its method")
                  for name in _REFERENCE if name not in stated]
    if stated and not (given.reference_note or "").strip():
        wrong.append(("reference_note", "is missing: state in words how the reference inertia is known"))
    if given.reference_note and not stated:
        wrong.append(("reference_inertia_kg_m2", "is missing: a note without a reference inertia has no meaning"))
    for option in OF_EVIDENCE:
        value = getattr(given, option.keyword)
        if option.kind is float and value is not None and (
                not isinstance(value, int | float) or option.refusal(value)):
            wrong.append((option.name, f"must be {option.refusal(float('nan'))}"))
        elif option.kind is str and value is not None and not isinstance(value, str):
            wrong.append((option.name, "must be a text"))
        elif isinstance(value, str) and option.longest is not None and len(value) > option.longest:
            wrong.append((option.name, f"must be at most {option.longest} characters"))
        elif option.known and value is not None and value not in option.known:
            wrong.append((option.name, f"must be {' or '.join(option.known)}"))
        elif isinstance(value, str) and (kinds := leaks_in([value])):
            wrong.append((option.name, f"contains a private text ({' and '.join(kinds)}): state it without"))
    return wrong


def statement_of(given: EvidenceOptions, *, serial_hmac_sha256: str = "") -> PublisherStatement:
    """Return the statement of options without mistakes."""
    reference = None
    if given.reference_inertia_kg_m2 is not None:
        reference = ReferenceInertia(float(given.reference_inertia_kg_m2), float(given.reference_sd_kg_m2 or 0.0),
                                     str(given.reference_method), _line(given.reference_note))
    return PublisherStatement(_line(given.publisher), parts_in(given.publish or ""), reference, _line(given.firmware),
                     given.simulated, serial_hmac_sha256)


def flag_of(name: str) -> str:
    """Return the flag of an option of the statement."""
    return _FLAG[name]


def serial_hmac(key: bytes, identity: Mapping[str, Any]) -> str:
    """Return HMAC-SHA-256 of vendor, product and serial number in hex; '' without a serial number.

    A plain hash of a number of 32 bits is found again by trying all of them, so the hash needs a key.
    """
    numbers = [identity.get(name) for name in ("vendor", "product", "serial")]
    if not numbers[-1]:
        return ""
    return hmac.new(key, "|".join(map(str, numbers)).encode(), hashlib.sha256).hexdigest()


def _line(text: str | None) -> str:
    return " ".join((text or "").split())
