"""Data of `tune`: the case, the rows, the advice."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf

import numpy as np

from profiles import MessageCode, TdhilError
from tdhil.soft_torque.controller import (
    Margins,
    NaturalMode,
    SpeedController,
    TopDrive,
)
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.simulation import (
    Search,
)
from tdhil.soft_torque.stability import (
    USUAL_MARGINS,
    LoopMargins,
    RequiredMargins,
)
from tdhil.soft_torque.uncertainty import DrawnValues, Interval, Truth, draw_truths

TUNING_REFUSED = 11
"""Exit code: the gains that were asked for would be unstable, or leave less margin than is required."""
STEPS = 9
"""Values of J, from end to end of its interval, at which what follows from it is worked out; odd."""
DRAWS = 20
"""Truths that a row's figures are taken over."""


class TuningRefused(TdhilError):
    """The gains that were asked for can't be recommended for this machine, and the message says why."""

    entry = MessageCode.TUNING_REFUSED

    exit_code = TUNING_REFUSED


@dataclass(frozen=True)
class Moved:
    """All as believed, but for one thing that is at an end of its 95 % interval; None: as believed."""

    inner_lags_s: tuple[float, ...] | None = None
    present: SpeedController | None = None
    string: DrillString | None = None


@dataclass(frozen=True)
class TuneCase:
    """String, drive, and all else that tuning needs, at the main shaft."""

    string: DrillString
    drive: TopDrive
    """With the J that is believed."""
    inertia_kg_m2: Interval
    phase_margin_deg: float = 60.0
    """Of the stiff controller."""
    softness: float | None = None
    """a, where it is asked for; None: the one with the lowest critical speed."""
    compensated_share: float | None = None
    """Share of J, where it is asked for; None: the one with the lowest critical speed."""
    present: SpeedController | None = None
    """The gains in the drive now, measured (`identify --impedance`) or typed; shown beside the others."""
    also: tuple[tuple[Moved, Moved], ...] = ()
    """What else is known to an interval only, each independent of the others: both ends of each."""
    required: RequiredMargins = USUAL_MARGINS
    """On every sampled truth."""
    lag_tolerance: float = 0.1
    """Relative, of each lag, where ``also`` has no lags."""
    string_draws: tuple[DrillString, ...] = ()
    """Strings drawn from the covariance of an identification; (): drawn from the string's own tolerances."""
    draws: int = DRAWS
    seed: int = 1

    def moved(self, by: Moved) -> TuneCase:
        """The case with that one thing moved."""
        lags = self.drive.inner_lags_s if by.inner_lags_s is None else by.inner_lags_s
        return replace(self, string=by.string or self.string, present=by.present or self.present,
                       drive=replace(self.drive, inner_lags_s=lags))

    def moves(self, *, present: bool) -> tuple[tuple[TuneCase, TuneCase], ...]:
        """Both ends of all that matters to a controller: to the ``present`` one its own gains, too."""
        return tuple((self.moved(low), self.moved(high)) for low, high in self.also
                     if present or low.present is None)

    @property
    def at_inertias(self) -> tuple[TopDrive, ...]:
        """The drive at `STEPS` values of J from end to end of its interval, the believed one in the middle."""
        return tuple(self.drive.with_inertia(one) for one in self.inertias(STEPS))

    def inertias(self, steps: int) -> tuple[float, ...]:
        """Return so many values of J (odd) from end to end of its interval, with the believed one in the middle."""
        low, value, high = self.inertia_kg_m2.low, self.inertia_kg_m2.value, self.inertia_kg_m2.high
        half = steps // 2
        below = [low + (value - low) * k / half for k in range(half)]
        return (*below, *(value + (high - value) * k / half for k in range(half + 1)))

    def truths(self) -> tuple[Truth, ...]:
        """Draw `draws` truths from all that is open."""
        lags, gains_open = [], []
        for low, high in self.also:
            if low.inner_lags_s is not None and high.inner_lags_s is not None:
                size = max(len(low.inner_lags_s), len(high.inner_lags_s), len(self.drive.inner_lags_s))
                ends = [np.array((*end, *(0.0,) * (size - len(end)))) for end in (low.inner_lags_s, high.inner_lags_s)]
                lags.append((0.5 * (ends[1] - ends[0])).tolist())
            if low.present is not None and high.present is not None:
                gains_open.append((0.5 * (high.present.gain_nm_s_rad - low.present.gain_nm_s_rad),
                                   0.5 * (high.present.integral_nm_rad - low.present.integral_nm_rad)))
        same = all(len(axis) == len(self.drive.inner_lags_s) for axis in lags)
        return draw_truths(
            self.string, self.drive, self.inertia_kg_m2, count=self.draws, seed=self.seed,
            lag_tolerance=self.lag_tolerance, lag_axes=lags if same else (), present=self.present,
            present_axes=gains_open, string_draws=self.string_draws)


@dataclass(frozen=True)
class WrongInertia:
    """The same recipe with a J that is wrong: ``error`` 0.126 is 12.6 % too large."""

    error: float
    stable: bool
    damping: float | None
    """The least of the lowest modes'; None: not stable."""
    cure_rpm: float | None


@dataclass(frozen=True)
class Tuned:
    """One controller, with all that follows from it. Refused: ``controller`` is None and ``refusal`` says why."""

    kind: str
    controller: SpeedController | None
    refusal: str = ""
    softness: float | None = None
    frequency_factor: float = 1.0
    """φ: I = (φω)² (J − J_c)."""
    softest: float | None = None
    """The a at which the lags make Z negative at low frequencies."""
    compensated_share: float = 0.0
    largest_share: float | None = None
    """That is stable for every J of the interval."""
    integral_nm_rad: Interval | None = None
    """I as J's interval has it."""
    reflection: Interval | None = None
    """|r| at the lowest mode; this and the next two over J's interval, the string as stated."""
    band_reflection: Interval | None = None
    """Mean |r| over `BAND_HZ`."""
    damping: Interval | None = None
    """The least of the lowest modes'."""
    modes: tuple[NaturalMode, ...] = ()
    margins: Margins | None = None
    """Of the bare drive."""
    with_string: LoopMargins | None = None
    """All as believed."""
    worst: LoopMargins | None = None
    """The least of each margin over all sampled truths."""
    failed: tuple[str, ...] = ()
    """Margins that are thinner than required on a sampled truth, with their numbers."""
    quiet_cures: tuple[float | None, ...] = ()
    """Cure speeds without bit noise, rpm, the string as stated, at values of J from end to end of its interval; None:
    above the highest that was tried; (): not simulated."""
    quiet_cures_moved: tuple[tuple[float | None, float | None], ...] = ()
    """At both ends of each other interval."""
    cure: DrawnValues | None = None
    """Under bit noise, rpm, over the sampled truths; so are the next two."""
    start: DrawnValues | None = None
    linear_limit: DrawnValues | None = None
    """Mean speed below which steady rotation is unstable."""
    wrong: tuple[WrongInertia, ...] = ()

    @property
    def quiet_cure_rpm(self) -> float | None:
        """Without bit noise, all as believed."""
        return self.quiet_cures[len(self.quiet_cures) // 2] if self.quiet_cures else None

    @property
    def lag_reserve_s(self) -> float | None:
        """Smallest further first-order lag in the loop that destabilises it; None: none does."""
        return None if self.with_string is None or self.with_string.lag_s == inf else self.with_string.lag_s

    @property
    def dead_time_reserve_s(self) -> float | None:
        """Smallest further dead time in the loop that destabilises it; None: none does."""
        found = self.with_string
        return None if found is None or found.dead_time_s == inf else found.dead_time_s


@dataclass(frozen=True)
class Advice:
    """Row to type in, or none."""

    kind: str | None
    """The row whose gains to type in; None: keep what there is, or nothing can be recommended."""
    compared_with: str
    """present, or stiff."""
    keep: bool
    """Nothing that keeps the margins is better than that."""
    better_share: float | None = None
    """Share of the sampled truths on which the critical speed isn't higher; None: not simulated."""


@dataclass(frozen=True)
class Tuning:
    """All controllers for one machine on one string."""

    case: TuneCase
    string_modes_hz: tuple[float, ...]
    """With the top held."""
    tuned: tuple[Tuned, ...]
    searched: Search | None
    """How critical speeds were looked for; None: not at all."""
    advice: Advice
    truths: tuple[Truth, ...] = field(default=(), repr=False)

    def by_kind(self, kind: str) -> Tuned | None:
        """The row of that name."""
        return next((one for one in self.tuned if one.kind == kind), None)
