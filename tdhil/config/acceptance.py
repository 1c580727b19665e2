"""Expected values of a rig with their tolerances: ``acceptance:`` in rig.yaml and ``--expect`` on the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from profiles.quantities import FRICTION, INERTIA, SHARE, STIFFNESS, TIME, TORQUE, Unit, read
from tdhil.config.options import OPTION
from tdhil.errors import MessageCode, UsageError


@dataclass(frozen=True)
class AcceptedQuantity:
    """Quantity that can be accepted: its unit, its label, and its place in the result document.

    ``unit``: None for an identity, a text that must be the same. ``reported``: place of the value that the drive itself
    reports, for a result that does not measure it.
    """

    unit: Unit | None
    label: str
    at: tuple[str, ...]
    reported: tuple[str, ...] = ()


ACCEPTED_QUANTITIES: Final[Mapping[str, AcceptedQuantity]] = MappingProxyType({
    "inertia": AcceptedQuantity(INERTIA, "moment of inertia J", ("inertia_kg_m2",)),
    "motor-inertia": AcceptedQuantity(INERTIA, "motor-side inertia J_r", ("inertia_kg_m2",)),
    "viscous": AcceptedQuantity(FRICTION, "viscous friction B", ("viscous_nm_s_rad",)),
    "coulomb": AcceptedQuantity(TORQUE, "Coulomb friction T_c", ("coulomb_nm",)),
    "speed-lag": AcceptedQuantity(TIME, "lag of the reported speed", ("speed_lag_s",)),
    "torque-lag": AcceptedQuantity(TIME, "lag of the reported torque", ("torque_lag_s",)),
    "gain": AcceptedQuantity(FRICTION, "gain P of the drive's speed loop", ("impedance", "gain_nm_s_rad"),
                             ("speed_loop_present", "gain_nm_s_rad")),
    "integral-gain": AcceptedQuantity(STIFFNESS, "integral gain I of the drive's speed loop",
                                      ("impedance", "integral_nm_rad"), ("speed_loop_present", "integral_nm_rad")),
    "torque-limit": AcceptedQuantity(TORQUE, "torque limit of the run", ("torque_limit_nm",)),
    "drive-serial": AcceptedQuantity(None, "serial number of the drive", ("drive", "serial")),
    "drive-name": AcceptedQuantity(None, "name of the drive", ("drive", "name")),
    "profile": AcceptedQuantity(None, "profile of the drive", ("profile", "name")),
})
"""Quantities by the names that an operator writes."""
_PARTS: Final = re.compile(r"\s*(?P<value>[^±]+?)\s*(?:±|\+/?-)\s*(?P<tolerance>.+?)\s*")
_EXAMPLE: Final = "104 ± 5 %"
_FLAG: Final = OPTION["expect"].flag


@dataclass(frozen=True)
class Expectation:
    """Expected value of one quantity, and its tolerance on either side, in SI. ``text``: an expected identity."""

    name: str
    value: float
    tolerance: float
    text: str = ""

    @staticmethod
    def of(name: str, text: str) -> Expectation:
        """Read ``104 ± 5 %`` or ``0.4 s ± 50 ms``. Raises ValueError with a text for the operator."""
        quantity = ACCEPTED_QUANTITIES.get(name)
        if quantity is None:
            raise ValueError(f"no quantity is called {name!r:.40}: {', '.join(ACCEPTED_QUANTITIES)}")
        if quantity.unit is None:
            if not text.strip():
                raise ValueError(f"the expected {quantity.label} is empty")
            return Expectation(name, 0.0, 0.0, text.strip())
        found = _PARTS.fullmatch(text)
        if found is None:
            raise ValueError(f"{text!r:.40} is not a value with its tolerance, such as {_EXAMPLE}")
        value = read(found["value"], quantity.unit)
        share = found["tolerance"].rstrip().endswith("%")
        tolerance = abs(value) * read(found["tolerance"], SHARE) if share else read(found["tolerance"], quantity.unit)
        if not tolerance > 0.0:
            raise ValueError(f"the tolerance must be above 0, not {found['tolerance']}")
        return Expectation(name, value, tolerance)


def expectations_of(rig: Mapping[str, str], given: Sequence[str]) -> tuple[Expectation, ...]:
    """Return the expectations of rig.yaml, each replaced by that of the command line. Raises UsageError with the
    option.
    """
    found = {name: Expectation.of(name, text) for name, text in rig.items()}
    for one in given:
        name, equals, text = one.partition("=")
        try:
            if not equals:
                raise ValueError(f"{one!r:.40} is not NAME=VALUE±TOLERANCE")
            found[name.strip()] = Expectation.of(name.strip(), text)
        except ValueError as error:
            raise UsageError(str(error), where=_FLAG, next_step=f"For example {_FLAG} 'inertia={_EXAMPLE}'",
                             entry=MessageCode.VALUE_NOT_ALLOWED) from None
    return tuple(found.values())


def expectations_in(run: Mapping[str, Any]) -> tuple[Expectation, ...]:
    """Return the expectations in the configuration of a log. The content of a log is not trusted."""
    rows = run.get("acceptance")
    return tuple(
        Expectation(one["name"], float(one["value"]), float(one["tolerance"]), str(one.get("text") or "")[:80])
        for one in (rows if isinstance(rows, list | tuple) else ())
        if isinstance(one, Mapping) and one.get("name") in ACCEPTED_QUANTITIES
        and all(isinstance(one.get(key), int | float) for key in ("value", "tolerance"))
    )
