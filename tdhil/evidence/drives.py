"""Conclusions from an archive: agreement with the reference inertia, and the profile entries that the run shows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Final

from tdhil.evidence.statement import PublisherStatement

LARGEST_SCORE: Final = 1.0
"""Largest En score of an agreement (ISO 13528:2022, 9.7)."""
LARGEST_UNCERTAINTY: Final = 0.1
"""Largest expanded uncertainty of the comparison that can show a unit of torque, as a share of the reference. A wider
one agrees with nearly every unit."""
CONFIDENCE: Final = 0.95
"""Coverage of both expanded uncertainties."""


@dataclass(frozen=True)
class Agreement:
    """Comparison of J with the reference inertia. ``score``: En = |J − J_ref|/√(U² + U_ref²), both U at 95 %.

    ``uncertainty_rel``: √(U² + U_ref²) as a share of the reference.
    """

    score: float
    deviation_rel: float
    uncertainty_rel: float

    @property
    def agrees(self) -> bool:
        """True if the difference is within the expanded uncertainty of both."""
        return self.score <= LARGEST_SCORE

    @property
    def text(self) -> str:
        """Sentence for a table."""
        word = "agrees" if self.agrees else "DISAGREES"
        return (f"{word}: J is {100 * self.deviation_rel:+.1f} % from the reference, expanded uncertainty"
                f" {100 * self.uncertainty_rel:.1f} %, En {self.score:.2f}")


def agreement_of(statement: PublisherStatement, result: Mapping[str, Any]) -> Agreement | None:
    """Return the comparison; None without a reference, without J, or without any uncertainty."""
    found, reference = result.get("inertia_kg_m2"), statement.reference
    if not isinstance(found, Mapping) or reference is None:
        return None
    k, stated = (NormalDist().inv_cdf(0.5 + 0.5 * one) for one in (CONFIDENCE, found.get("confidence", CONFIDENCE)))
    own = 0.5 * (found["high_total"] - found["low_total"]) * k / stated
    both = math.hypot(own, k * reference.sd_kg_m2)
    difference = found["value"] - reference.inertia_kg_m2
    if both <= 0.0:
        return None
    return Agreement(abs(difference) / both, difference / reference.inertia_kg_m2, both / reference.inertia_kg_m2)


def shown_entries(
    run: Mapping[str, Any], statement: PublisherStatement, result: Mapping[str, Any], *, torque_mode: bool
) -> dict[str, str]:
    """Return the entries of the profile that this run of a real drive shows to be right, each with the observation.

    ``run``: the log's configuration; ``torque_mode``: the drive confirmed its torque mode under way. A simulated drive
    shows none. An entry that was only read back, such as a watchdog, is not shown: its effect was not observed.
    """
    if result.get("simulated") is not False or statement.simulated:
        return {}
    speed, stop = (dict(run.get(name) or {}) for name in ("speed_unit", "stop"))
    agreement = agreement_of(statement, result)
    agrees = agreement is not None and agreement.agrees and agreement.uncertainty_rel <= LARGEST_UNCERTAINTY
    valid = result.get("verdict") in ("valid", "valid_wide")
    why: dict[str, str] = {}
    if speed.get("seen_by"):
        why["speed"] = f"the unit of speed was compared with the shaft ({speed['seen_by']})"
    if speed.get("seen_by") == "position":
        why["position"] = "angle and speed agree"
    if stop.get("confirmed") is True:
        why["quick_stop"] = "the quick stop ended at a confirmed standstill"
    if valid and torque_mode:
        why["modes"] = "the drive changed to torque mode under way, and J is valid"
    if valid and agrees and agreement is not None:
        why["torque"] = agreement.text
    return {name: why[name] for name, _ in entries_of(run.get("profile")) if name in why}


_ABOUT: Final = frozenset({"source", "confidence", "note"})
"""Keys of an entry that state no property of the drive."""


def entries_of(profile: Any) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield name and values of each section of a profile that has a source and a confidence."""
    if isinstance(profile, Mapping):
        for name, part in profile.items():
            if isinstance(part, Mapping) and {"source", "confidence"} <= set(part):
                yield str(name), {key: value for key, value in part.items() if key not in _ABOUT}


def covered_entries(profile: Any, shown: Mapping[str, str], today: Any) -> dict[str, str]:
    """Return the shown entries that still have the values of the run, each with the observation.

    ``profile``: that of the run; ``today``: the profile of the same name as tdhil contains it, or None.
    """
    present = dict(entries_of(today))
    return {name: shown[name] for name, claim in entries_of(profile) if name in shown and present.get(name) == claim}
