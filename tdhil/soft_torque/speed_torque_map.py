"""Operator's map of set speed and bit torque: stable rotation, risk of stick-slip, and stick-slip.

Each cell is simulated under bit noise, twice for each seed: from steady rotation, and from a stuck bit.
*Stick-slip*: a turning bit sticks. *At risk*: a turning bit goes on turning, but a stuck bit, for example after a
connection, does not come free. *Stable*: the bit turns at the end of both simulations. String, J and lags have their
stated values. The bit's torque and its noise are scaled together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from tdhil.soft_torque.controller import SpeedController
from tdhil.soft_torque.critical_speed import CALM_PERIODS, PERIODS, Search, coarse_tick_s, ends_turning
from tdhil.soft_torque.simulation import Start
from tdhil.soft_torque.tune_case import Tuning

MAP_SPEEDS_RPM = tuple(float(one) for one in range(20, 221, 20))
MAP_TORQUE_SHARES = (0.4, 0.6, 0.8, 1.0, 1.2, 1.4)
"""Bit torques of the map, as shares of the stated bit's."""
MAP_SEEDS = (11, 12, 13)
"""Seeds of the bit noise. A cell shows the worst state over all seeds."""

_STARTS: tuple[Start, Start] = ("turning", "stuck")

State = Literal["stable", "at risk", "stick-slip"]


@dataclass(frozen=True)
class OperatorMap:
    """Operator's map. ``states``: for each controller, a row for each bit torque with a state for each set speed."""

    speeds_rpm: tuple[float, ...]
    bit_torques_nm: tuple[float, ...]
    """Coulomb torque of the bit, which acts while it turns fast."""
    states: dict[str, tuple[tuple[State, ...], ...]]
    weights_on_bit_kn: tuple[float, ...] | None = None
    """Weight on bit for each bit torque. None: string.yaml states no torque per weight on bit."""


def operator_map(tuning: Tuning) -> OperatorMap | None:
    """Return the map for the stiff, the present and the advised gains (without advice: the soft ones).

    Returns None if no bit is stated or if critical speeds were not simulated.
    """
    case = tuning.case
    bit = case.string.bit
    if bit is None or tuning.searched is None:
        return None
    wanted = ("stiff", "present", tuning.advice.kind or "soft")
    laws = {one.kind: one.controller for one in tuning.tuned if one.kind in wanted and one.controller is not None}
    strings = [replace(case.string, bit=replace(bit, coulomb_nm=share * bit.coulomb_nm, static_nm=share * bit.static_nm,
                                                noise_nm=share * bit.noise_nm)) for share in MAP_TORQUE_SHARES]
    cases: list[tuple[SpeedController, int, int]] = [
        (law, at, seed) for law in laws.values() for at in range(len(strings)) for seed in MAP_SEEDS]
    period_s = 1.0 / tuning.string_modes_hz[0]
    search = Search(duration_s=PERIODS * period_s, calm_s=CALM_PERIODS * period_s,
                    longest_tick_s=coarse_tick_s(case.string))
    speeds = np.tile(np.array(MAP_SPEEDS_RPM), (len(cases), 1))
    shape = (len(laws), len(strings), len(MAP_SEEDS), len(MAP_SPEEDS_RPM))
    strings_of, loops = [strings[at] for _, at, _ in cases], [(case.drive, law) for law, _, _ in cases]
    seeds = [seed for _, _, seed in cases]
    turns, comes_free = (
        np.asarray(np.all(ends_turning(strings_of, loops, how, speeds, search, seeds).reshape(shape), axis=2))
        for how in _STARTS)
    torques = tuple(share * bit.coulomb_nm for share in MAP_TORQUE_SHARES)
    per_weight = bit.torque_per_weight_nm_kn
    return OperatorMap(
        MAP_SPEEDS_RPM, torques,
        {kind: tuple(_row(turns[k, row].tolist(), comes_free[k, row].tolist()) for row in range(len(strings)))
         for k, kind in enumerate(laws)},
        None if per_weight is None else tuple(torque / per_weight for torque in torques))


def _row(turns: Sequence[bool], comes_free: Sequence[bool]) -> tuple[State, ...]:
    return tuple("stick-slip" if not one else "stable" if other else "at risk"
                 for one, other in zip(turns, comes_free, strict=True))
