r"""Joint draws of all uncertain parameters: rotor, lags, present gains, string and bit.

The data allow many machines, and the true machine is one of them. Each draw is one of them, a `Truth`: J from its
interval, and every lag and every property of string and bit within its tolerance, all at once. The figures of a
controller are computed on each truth. The spread over the truths gives the interval of a figure.

The draws form a Latin hypercube: each property takes one value from every part of its range (McKay, Beckman and Conover
1979), so about twenty draws represent the whole range. From n draws, the interval of one further draw is
mean ± t s √(1 + 1/n) of the logarithm, with Student's t for n − 1 degrees of freedom (prediction interval,
ISO 16269-8).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.drill_string import DrillString

COVERAGE_K = 1.959964
"""Half-width of a normal 95 % interval in standard deviations (coverage factor)."""
COLUMNS_OF_STRING = 11
"""Number of drawn properties of string and bit. Their columns follow that of J and precede those of lags and gains."""


@dataclass(frozen=True)
class Interval:
    """Value with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Truth:
    """One machine and one string that the data allow."""

    string: DrillString
    drive: TopDrive
    present: SpeedController | None
    seed: int
    """Seed of the bit noise in its simulation."""


@dataclass(frozen=True)
class DrawnValues:
    """Values of one quantity over all draws. A value above the highest that was tried is infinite."""

    values: tuple[float, ...]
    lowest_tried: float = 0.0
    """Lowest value that was tried. A value at or below it is an upper bound only."""

    @property
    def median(self) -> float | None:
        """Median of the draws. None: the median is above the highest value that was tried."""
        middle = float(np.median(self.values))
        return middle if middle < inf else None

    def interval(self, resolution: float = 0.0) -> tuple[float, float | None]:
        """Return the 95 % prediction interval of one further draw, widened by half of the search's resolution.

        The high end is None if any draw is infinite. Values are positive or 0.
        """
        found = np.array([one for one in self.values if one < inf])
        if not found.size:
            return 0.0, None
        low, high = float(found.min()), float(found.max())
        if found.size > 2 and low > 0.0:
            logs = np.log(found)
            half = student_factor(found.size - 1) * float(logs.std(ddof=1)) * sqrt(1.0 + 1.0 / found.size)
            middle = float(logs.mean())
            low, high = min(low, exp(middle - half)), max(high, exp(middle + half))
        low, high = max(0.0, low - 0.5 * resolution), high + 0.5 * resolution
        if float(found.min()) <= self.lowest_tried:
            low, high = 0.0, max(high, self.lowest_tried)
        return low, high if found.size == len(self.values) else None


def student_factor(dof: int) -> float:
    """Return Student's t of a 95 % interval. scipy.stats gives the identical value, but takes a second to load."""
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.975))


def draw_truths(
    string: DrillString, drive: TopDrive, inertia: Interval, *, count: int, seed: int = 1,
    lag_tolerance: float = 0.0,
    lag_axes: Sequence[Sequence[float]] = (),
    present: SpeedController | None = None,
    present_axes: Sequence[tuple[float, float]] = (),
    string_draws: Sequence[tuple[DrillString, float | None]] = (),
) -> tuple[Truth, ...]:
    """Draw ``count`` truths.

    ``lag_axes``: half of the 95 % range of the lags along each main axis, s. ``lag_tolerance``: relative tolerance ± of
    each lag, used without ``lag_axes``. ``present_axes``: half-ranges of (P, I). ``string_draws``: strings that were
    drawn before, from the values of an identification, each with its J, kg·m², if both were drawn jointly
    (`joint_draws`); else with None, and J is independent. Without them, each string is drawn from the tolerances of
    ``string``.
    """
    lags = drive.inner_lags_s
    free = len(lag_axes) if lag_axes else len(lags)
    cube = _latin_hypercube(count, 1 + COLUMNS_OF_STRING + free + len(present_axes), seed)
    found = []
    for number, row in enumerate(cube):
        normal = _normal(row)
        j = normal[0] / COVERAGE_K
        value = inertia.value + j * (inertia.high - inertia.value if j > 0.0 else inertia.value - inertia.low)
        at = 1 + COLUMNS_OF_STRING
        if lag_axes:
            moved = np.array(lags, dtype=float)
            for k, axis in enumerate(lag_axes):
                moved = moved + normal[at + k] / COVERAGE_K * np.array(axis)
        else:
            moved = np.array(lags) * (1.0 + lag_tolerance * (2.0 * row[at : at + free] - 1.0))
        law = present
        if law is not None and present_axes:
            p, i = (sum(normal[at + free + k] / COVERAGE_K * axis[which] for k, axis in enumerate(present_axes))
                    for which in (0, 1))
            law = replace(law, gain_nm_s_rad=max(0.0, law.gain_nm_s_rad + p),
                          integral_nm_rad=max(0.0, law.integral_nm_rad + i))
        own, joint = (string_draws[number % len(string_draws)] if string_draws
                      else (string_at(string, row[1 : 1 + COLUMNS_OF_STRING]), None))
        true = replace(drive, inertia_kg_m2=max(1e-6, float(value if joint is None else joint)),
                       inner_lags_s=tuple(float(max(0.0, lag)) for lag in moved))
        found.append(Truth(own, true, law, 1000 * seed + number))
    return tuple(found)


def joint_draws(
    intervals: Sequence[Interval], correlation: NDArray[np.float64], *, count: int, seed: int
) -> NDArray[np.float64]:
    """Return joint draws (count, K) of correlated estimates, each with the spread of its own 95 % interval.

    ``correlation`` (K, K). A normal copula: correlated normal draws, each stretched to both half-widths of its
    interval. The normal draws are a Latin hypercube, so the first estimate takes one value from every part of its
    range.
    """
    size = len(intervals)
    normal = np.array([_normal(row) for row in _latin_hypercube(count, size, seed)])
    normal = normal - normal.mean(axis=0)                   # few draws: without their chance correlation
    normal = normal @ np.linalg.inv(np.linalg.cholesky(normal.T @ normal / count)).T
    root = np.linalg.cholesky(correlation + 1e-9 * np.eye(size))
    drawn: NDArray[np.float64] = normal @ root.T / COVERAGE_K
    low, value, high = (np.array([getattr(one, name) for one in intervals]) for name in ("low", "value", "high"))
    found: NDArray[np.float64] = value + drawn * np.where(drawn > 0.0, high - value, value - low)
    return found


def independent_axes(
    intervals: Sequence[Interval], correlation: NDArray[np.float64]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
    """Return both ends (K,) of each of K independent axes of correlated estimates.

    ``correlation`` (K, K). Axis k leaves the estimates before k unchanged (Cholesky), so the last axis moves only the
    last estimate. For a linear function, the root of the sum of squares over the axes is its half-width.
    """
    root = np.linalg.cholesky(correlation + 1e-9 * np.eye(len(intervals)))
    low, value, high = (np.array([getattr(one, name) for one in intervals]) for name in ("low", "value", "high"))

    def end(axis: NDArray[np.float64]) -> NDArray[np.float64]:
        moved: NDArray[np.float64] = value + axis * np.where(axis > 0.0, high - value, value - low)
        return moved

    return tuple((end(-axis), end(axis)) for axis in root.T)


@dataclass(frozen=True)
class StringFactors:
    """Factors on the stated properties of a string. Pipe has diameters and wear; a bottom-hole assembly has neither."""

    length: float = 1.0
    shear: float = 1.0
    wear: float = 1.0
    outer: float = 1.0
    inner: float = 1.0
    drag: float = 1.0
    wall: float = 1.0
    bottom: float = 1.0
    """Inertia at the bottom, and polar moment of area of the sections of the bottom-hole assembly."""

    def applied_to(self, string: DrillString) -> DrillString:
        """Return the string with these factors. The travel times of all lines change by one common factor."""
        lines = []
        for line in string.lines:
            hollow = line.outer_share * self.outer**4 - (line.outer_share - 1.0) * self.inner**4
            polar = self.bottom if line.in_bottom else self.wear * hollow
            lines.append(replace(
                line, length_m=self.length * line.length_m, inertia_kg_m=polar * line.inertia_kg_m,
                compliance_rad_nm_m=line.compliance_rad_nm_m / (self.shear * polar),
                drag_nm_s_rad_m=self.drag * line.drag_nm_s_rad_m, coulomb_nm_m=self.wall * line.coulomb_nm_m,
                static_nm_m=self.wall * line.static_nm_m))
        return replace(string, lines=tuple(lines), bottom_inertia_kg_m2=self.bottom * string.bottom_inertia_kg_m2)


def string_at(string: DrillString, shares: NDArray[np.float64]) -> DrillString:
    """Return the string at the given positions (0 to 1) in the ranges of its `COLUMNS_OF_STRING` tolerances."""
    tolerance = string.tolerance

    def within(low: float, high: float, share: float) -> float:
        return low + (high - low) * float(share)

    def about(half_width: float, share: float) -> float:
        return within(1.0 - half_width, 1.0 + half_width, share)

    def times(factor: float, share: float) -> float:
        return exp(log(factor) * (2.0 * float(share) - 1.0))

    moved = StringFactors(
        about(tolerance.length, shares[0]), within(*tolerance.shear, shares[1]), within(*tolerance.polar, shares[2]),
        about(tolerance.outer_diameter, shares[3]), about(tolerance.inner_diameter, shares[4]),
        times(tolerance.drag_factor, shares[5]), times(tolerance.wall_friction_factor, shares[6]),
        about(tolerance.bottom_inertia, shares[7])).applied_to(string)
    bit = string.bit
    if bit is None:
        return moved
    size = about(tolerance.bit_torque, shares[8])
    return replace(moved, bit=replace(
        bit, coulomb_nm=size * bit.coulomb_nm, static_nm=size * bit.static_nm,
        stribeck_speed_rad_s=times(tolerance.stribeck_factor, shares[9]) * bit.stribeck_speed_rad_s,
        noise_nm=times(tolerance.noise_factor, shares[10]) * bit.noise_nm))


def _latin_hypercube(count: int, columns: int, seed: int) -> NDArray[np.float64]:
    random = np.random.default_rng(seed)
    cells = np.array([random.permutation(count) for _ in range(columns)]).T
    shares: NDArray[np.float64] = (cells + random.random((count, columns))) / count
    return shares


def _normal(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.special import ndtri

    found: NDArray[np.float64] = ndtri(np.clip(shares, 1e-6, 1.0 - 1e-6))
    return found
