"""Data of `tune`: the case, the controllers (rows), the advice."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import zip_longest
from math import inf

import numpy as np

from profiles import MessageCode, TdhilError
from tdhil.soft_torque.controller import Margins, NaturalMode, SpeedController, TopDrive
from tdhil.soft_torque.critical_speed import Search
from tdhil.soft_torque.drill_string import DrillString
from tdhil.soft_torque.stability import USUAL_MARGINS, LoopMargins, RequiredMargins
from tdhil.soft_torque.uncertainty import DrawnValues, Interval, Truth, draw_truths

TUNING_REFUSED = 11
"""Exit code: the requested gains would be unstable, or would leave less than the required margins."""
STEPS = 9
"""Number of values of J, from end to end of its interval, at which figures are computed; odd."""
DRAWS = 20
"""Number of truths from which the figures of a row are computed."""


class TuningRefused(TdhilError):
    """Refusal: the requested gains cannot be recommended for this machine. The message gives the reason."""

    entry = MessageCode.TUNING_REFUSED

    exit_code = TUNING_REFUSED


@dataclass(frozen=True)
class Moved:
    """Nominal values, except one parameter at an end of its 95 % interval. None: the parameter is nominal."""

    inner_lags_s: tuple[float, ...] | None = None
    present: SpeedController | None = None
    string: DrillString | None = None
    inertia_kg_m2: float | None = None
    """J, if it is correlated with the moved parameter."""


@dataclass(frozen=True)
class TuneCase:
    """String, drive, and all other data for tuning, at the main shaft."""

    string: DrillString
    drive: TopDrive
    """Top drive with the estimated J."""
    inertia_kg_m2: Interval
    phase_margin_deg: float = 60.0
    """Phase margin of the stiff controller."""
    softness: float | None = None
    """Requested softness a. None: the one with the lowest critical speed is searched."""
    compensated_share: float | None = None
    """Requested compensated share of J. None: the one with the lowest critical speed is searched."""
    present: SpeedController | None = None
    """Present gains of the drive, measured (`identify --impedance`) or typed in. They are shown beside the others."""
    also: tuple[tuple[Moved, Moved], ...] = ()
    """Other parameters that are known with an interval, both ends of each. They are independent of each other.
    Correlated ones are replaced by independent axes of their covariance, each with both ends; J moves along."""
    inertia_alone_share: float = 1.0
    """Share of J's half-width that remains if all of ``also`` is held; 1: J is independent of them."""
    required: RequiredMargins = USUAL_MARGINS
    """Margins that are required on every sampled truth."""
    lag_tolerance: float = 0.1
    """Relative tolerance of each lag, if ``also`` contains no lags."""
    string_draws: tuple[DrillString, ...] = ()
    """Strings drawn from the values of an identification; (): they are drawn from the string's own tolerances."""
    inertia_draws: tuple[float, ...] = ()
    """J of each of ``string_draws``, kg·m², if the result states the covariance of J and string; (): J is independent
    of the string."""
    draws: int = DRAWS
    """Number of truths."""
    seed: int = 1
    """Seed of the draws."""

    def moved(self, by: Moved) -> TuneCase:
        """Return the case with one parameter moved to an end of its interval."""
        lags = self.drive.inner_lags_s if by.inner_lags_s is None else by.inner_lags_s
        return replace(self, string=by.string or self.string, present=by.present or self.present,
                       drive=replace(self.drive, inner_lags_s=lags,
                                     inertia_kg_m2=by.inertia_kg_m2 or self.drive.inertia_kg_m2))

    def moves(self, *, present: bool) -> tuple[tuple[TuneCase, TuneCase], ...]:
        """Return both ends of every other parameter. ``present``: the interval of the present gains is included."""
        return tuple((self.moved(low), self.moved(high)) for low, high in self.also
                     if present or low.present is None)

    @property
    def inertia_alone(self) -> Interval:
        """Interval of J with all of ``also`` held, kg·m²."""
        whole, share = self.inertia_kg_m2, self.inertia_alone_share
        return Interval(whole.value, whole.value - share * (whole.value - whole.low),
                        whole.value + share * (whole.high - whole.value))

    @property
    def at_inertias(self) -> tuple[TopDrive, ...]:
        """The drive at the `STEPS` values of J of `inertias`."""
        return tuple(self.drive.with_inertia(one) for one in self.inertias(STEPS))

    def inertias(self, steps: int) -> tuple[float, ...]:
        """Return ``steps`` (odd) values of J from end to end of `inertia_alone`, with the estimated J in the middle."""
        alone = self.inertia_alone
        low, value, high = alone.low, alone.value, alone.high
        half = steps // 2
        below = [low + (value - low) * k / half for k in range(half)]
        return (*below, *(value + (high - value) * k / half for k in range(half + 1)))

    def truths(self) -> tuple[Truth, ...]:
        """Draw `draws` truths from the intervals and tolerances of all parameters."""
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
            present_axes=gains_open,
            string_draws=tuple(zip_longest(self.string_draws, self.inertia_draws)))


@dataclass(frozen=True)
class WrongInertia:
    """Effect of a wrong J on a recipe: the gains are computed from J (1 + ``error``). 0.126 is 12.6 % too large."""

    error: float
    stable: bool
    damping: float | None
    """Least damping ratio of the string's lowest modes. None: not stable."""
    cure_rpm: float | None
    """Cure speed without bit noise, rpm. None: not stable, not simulated, or above the highest that was tried."""


@dataclass(frozen=True)
class Tuned:
    """One controller with its figures. If it is refused, ``controller`` is None and ``refusal`` gives the reason."""

    kind: str
    controller: SpeedController | None
    refusal: str = ""
    softness: float | None = None
    frequency_factor: float = 1.0
    """Frequency factor φ: I = (φω)² (J − J_c)."""
    softest: float | None = None
    """Softness a above which the lags make Re Z negative at low frequencies."""
    compensated_share: float = 0.0
    largest_share: float | None = None
    """Largest compensated share that is stable for every J of the interval."""
    integral_nm_rad: Interval | None = None
    """Integral gain I, with its interval from the interval of J."""
    reflection: Interval | None = None
    """Reflection |r| at the lowest mode, over the interval of J, for the stated string."""
    band_reflection: Interval | None = None
    """Mean |r| over `BAND_HZ`, over the interval of J, for the stated string."""
    damping: Interval | None = None
    """Least damping ratio of the string's lowest modes, over the interval of J, for the stated string."""
    modes: tuple[NaturalMode, ...] = ()
    margins: Margins | None = None
    """Margins of the bare drive, and modulus with the string coupled."""
    with_string: LoopMargins | None = None
    """Margins with the string coupled, at nominal values."""
    worst: LoopMargins | None = None
    """Least value of each margin over all sampled truths."""
    failed: tuple[str, ...] = ()
    """Margins that are below the required ones on a sampled truth, with their values."""
    quiet_cures: tuple[float | None, ...] = ()
    """Cure speeds without bit noise, rpm, for the stated string, at values of J from end to end of its interval. None:
    above the highest that was tried. (): not simulated."""
    quiet_cures_moved: tuple[tuple[float | None, float | None], ...] = ()
    """Cure speeds without bit noise, rpm, at both ends of the interval of each other parameter."""
    cure: DrawnValues | None = None
    """Cure speed under bit noise over the sampled truths, rpm."""
    start: DrawnValues | None = None
    """Lowest set speed at which the bit turns after a ramp from standstill, under bit noise, rpm; over some truths."""
    linear_limit: DrawnValues | None = None
    """Mean speed below which steady rotation is unstable, over the sampled truths, rpm."""
    wrong: tuple[WrongInertia, ...] = ()
    """Effect of errors of J on this recipe."""

    @property
    def quiet_cure_rpm(self) -> float | None:
        """Cure speed without bit noise at nominal values, rpm."""
        return self.quiet_cures[len(self.quiet_cures) // 2] if self.quiet_cures else None

    @property
    def lag_reserve_s(self) -> float | None:
        """Smallest additional first-order lag that makes the loop unstable, s. None: none does."""
        return None if self.with_string is None or self.with_string.lag_s == inf else self.with_string.lag_s

    @property
    def dead_time_reserve_s(self) -> float | None:
        """Smallest additional dead time that makes the loop unstable, s. None: none does."""
        found = self.with_string
        return None if found is None or found.dead_time_s == inf else found.dead_time_s


@dataclass(frozen=True)
class Advice:
    """Recommended row, or the advice to keep the present gains."""

    kind: str | None
    """Row whose gains to type in. None: keep the present gains, or nothing was compared."""
    compared_with: str
    """Row with which the others are compared: present, or stiff."""
    keep: bool
    """True: no row that keeps the margins is better than ``compared_with``. False without ``kind``: nothing was
    compared."""
    better_share: float | None = None
    """Share of the sampled truths on which the critical speed is not higher. None: not simulated."""
    less_bad: str | None = None
    """Row that fails a margin too, but is better in each than ``compared_with``, and not worse in critical speed. None:
    there is no such row, ``compared_with`` keeps the margins, or another row is recommended."""


@dataclass(frozen=True)
class Tuning:
    """All controllers for one machine on one string."""

    case: TuneCase
    string_modes_hz: tuple[float, ...]
    """Frequencies of the string's lowest modes with the top held."""
    tuned: tuple[Tuned, ...]
    searched: Search | None
    """Settings of the search for critical speeds. None: there was no search."""
    advice: Advice
    truths: tuple[Truth, ...] = field(default=(), repr=False)

    def by_kind(self, kind: str) -> Tuned | None:
        """Return the row of that kind, or None."""
        return next((one for one in self.tuned if one.kind == kind), None)
