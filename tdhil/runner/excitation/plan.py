"""Scale an excitation to the rig's speed window and torque limit, or refuse it before motion."""

import math
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from profiles.quantities import in_rad_s_and_rpm, rpm_advice
from tdhil.config import DEFAULT_EXCITATION, OPTION, identified_before_echo
from tdhil.recording import Segment
from tdhil.runner.excitation import signals
from tdhil.runner.excitation.reference import (
    USUAL_STEP,
    DriveMode,
    MotionLimits,
    PeriodicReference,
    PlanRefused,
    RigGuess,
    Transition,
    excitation_kind,
    make_transition,
)
from tdhil.runner.excitation.signals import PeriodicKind, Shape, begun_at_rest, other_phases

_OFFSET_SHARE = 0.38     # least distance of the two mean speeds, share of the usable window: lever for B
LEAST_COUNTED = 6        # least number of evaluated periods at each mean speed: their scatter sets the weights
RAMP_SHARE = 0.9         # share of the acceleration that the drive's own ramp permits, as measured in stage 2
_BACKWARDS_SHARE = 0.012  # share of the highest speed; a predicted reverse speed below it is permitted by the guard
SETTLE_S = 10.0          # s; least settling time before the first evaluated period


@dataclass(frozen=True)
class PlanRequest:
    """The user's request; None means that the plan chooses.

    ``frequency_hz``: frequency of the lowest line (multisine), tone (sine) or square wave (step). ``amplitude_rad_s``:
    largest deviation of speed from its mean. ``offsets_rad_s``: mean speeds, one segment each. ``periods``: number per
    segment, with settling. ``shape``: lines that replace those of the multisine. ``offset_share``: least distance of
    two mean speeds that the plan chooses, as a share of the usable window (lever for the slope of friction).
    ``realisations``: sets of phases at each mean speed, each in a segment of its own with the same amplitudes. No two
    segments share a set, except with one realisation.
    ``settle_s``: least settling time of each segment.
    """

    kind: str = DEFAULT_EXCITATION
    mode: DriveMode = "torque"
    frequency_hz: float | None = None
    amplitude_rad_s: float | None = None
    offsets_rad_s: tuple[float, ...] | None = None
    periods: int | None = None
    shape: Shape | None = None
    offset_share: float | None = None
    settle_s: float = SETTLE_S
    realisations: int = 1


@dataclass(frozen=True)
class PlannedSegment:
    """Segment at one mean speed, with one set of phases.

    It has its reference from its start, a number of periods, and a predicted range of speed and torque.
    """

    reference: PeriodicReference
    periods: int
    settle_periods: int
    speed_min_rad_s: float    # this range is predicted with the rough inertia
    speed_max_rad_s: float
    torque_min_nm: float
    torque_max_nm: float

    @property
    def duration_s(self) -> float:
        return self.periods * self.reference.period_s

    def recorded(self, start_s: float, end_s: float | None = None) -> Segment:
        """Return the segment for a recording. ``end_s`` is rounded down to the end of the last complete period."""
        end = start_s + self.duration_s if end_s is None else end_s
        period = self.reference.period_s
        whole = min(self.periods, max(0, math.floor((end - start_s) / period + 1e-6)))
        return Segment(
            start_s=start_s,
            end_s=start_s + whole * period,
            period_s=period,
            settle_periods=self.settle_periods,
            offset_rad_s=self.reference.offset_rad_s,
            lines_hz=self.reference.lines_hz,
            amplitudes_rad_s=self.reference.amplitudes_rad_s,
            phases_rad=self.reference.phases_rad,
        )


@dataclass(frozen=True)
class Plan:
    """Motion of stage 5: its segments in order, with transitions between them."""

    kind: str
    mode: DriveMode
    segments: tuple[PlannedSegment, ...]
    limits: MotionLimits
    guess: RigGuess

    @property
    def start_rad_s(self) -> float:
        """Return the first mean speed, rad/s."""
        return self.segments[0].reference.offset_rad_s

    def plain(self) -> dict[str, Any]:
        """Return its motion as plain data."""
        return {
            "segments": [
                {
                    "offset_rad_s": one.reference.offset_rad_s,
                    "period_s": one.reference.period_s,
                    "periods": one.periods,
                    "settle_periods": one.settle_periods,
                    "lines_hz": list(one.reference.lines_hz),
                    "amplitudes_rad_s": list(one.reference.amplitudes_rad_s),
                }
                for one in self.segments
            ],
            "ways": [],
        }

    def parts(self) -> list[tuple[str, str]]:
        """Return (place, text) for display: one for each segment."""
        return [
            (f"at {one.reference.offset_rad_s:.3g} rad/s",
             f"{one.periods} periods of {one.reference.period_s:.3g} s, {one.settle_periods} to settle")
            for one in self.segments
        ]

    def lines(self) -> list[tuple[float, float]]:
        """Return (Hz, rad/s) of every line; the same at each mean speed."""
        reference = self.segments[0].reference
        return list(zip(reference.lines_hz, reference.amplitudes_rad_s, strict=True))

    @property
    def speed_min_rad_s(self) -> float:
        return min(segment.speed_min_rad_s for segment in self.segments)

    @property
    def speed_max_rad_s(self) -> float:
        return max(segment.speed_max_rad_s for segment in self.segments)

    @property
    def torque_min_nm(self) -> float:
        return min(segment.torque_min_nm for segment in self.segments)

    @property
    def torque_max_nm(self) -> float:
        return max(segment.torque_max_nm for segment in self.segments)

    @property
    def duration_s(self) -> float:
        """Return the duration of segments and transitions, s, without the transition to the first segment."""
        between = sum(
            self.transition(before.reference.start_speed_rad_s, index + 1).duration_s
            for index, before in enumerate(self.segments[:-1])
        )
        return between + sum(segment.duration_s for segment in self.segments)

    def followed(self, hertz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the ratio of the shaft's motion to the reference, (K,): one in torque mode, or if it is unknown."""
        following = self.guess.following
        if self.mode != "speed" or following is None:
            return np.ones(len(hertz), dtype=np.complex128)
        return following.shaft(hertz)

    @property
    def counted(self) -> int:
        """Return the evaluated periods of each segment."""
        return self.segments[0].periods - self.segments[0].settle_periods

    def with_counted(self, periods: int) -> "Plan":
        """Return the same motion with this number of evaluated periods in each segment, besides settling."""
        segments = tuple(replace(segment, periods=segment.settle_periods + periods) for segment in self.segments)
        return replace(self, segments=segments)

    def extension_s(self, periods: int) -> float:
        """Return the time of further periods, s: in the last segment first, then in the others with settling."""
        others = self.segments[:-1]
        again = sum(one.settle_periods * one.reference.period_s for one in others)
        ways = sum(
            self.transition(self.segments[-1].reference.start_speed_rad_s, index).duration_s
            for index in range(len(others))
        )
        return again + ways + periods * sum(one.reference.period_s for one in self.segments)

    def transition(self, from_rad_s: float, index: int) -> Transition:
        """Return the transition from a speed to the start of segment ``index``."""
        to = self.segments[index].reference.start_speed_rad_s
        return make_transition(from_rad_s, to, self.limits, self.guess, self.mode)


def make_plan(limits: MotionLimits, guess: RigGuess, wish: PlanRequest | None = None) -> Plan:
    """Return a plan that stays within the limits even if the rough inertia is wrong by its stated error.

    Raises PlanRefused, with the limit, if the request does not fit.
    """
    wish = wish or PlanRequest()
    kind = periodic_kind(wish.kind)
    frequency = kind.frequency_hz if wish.frequency_hz is None else wish.frequency_hz
    if not (math.isfinite(frequency) and frequency > 0.0):
        raise PlanRefused(f"frequency must be positive, not {frequency:g} Hz")
    if identified_before_echo(wish.kind) and frequency > kind.frequency_hz:
        raise PlanRefused(
            f"{wish.kind} with lines {frequency:g} Hz apart can't separate an echo from the time before it",
            f"Remove --frequency ({kind.frequency_hz:g} Hz), or give a lower one",
        )
    shape = kind.shape() if wish.shape is None else wish.shape
    period = 1.0 / frequency
    if wish.realisations > 1 and not kind.tuned:
        raise PlanRefused(
            f"the phases of {wish.kind} are part of its form, so it has one realisation", "Remove --realisations",
        )
    speeds = 2 if wish.offsets_rad_s is None else len(wish.offsets_rad_s)     # of a tuned motion
    fits = [
        _FittedShape.of(
            begun_at_rest(other_phases(shape, number), period, guess.inertia_kg_m2, guess.viscous_nm_s_rad),
            period, limits, guess, wish.mode,
        )
        for number in range(1 if wish.realisations == 1 else wish.realisations * speeds)
    ]
    amplitude, offsets = _amplitude_and_offsets(fits, wish)
    each = [offset for offset in offsets for _ in range(wish.realisations)]
    settle = settling_periods(period, wish.settle_s)
    periods = _periods(wish, period, settle)
    return Plan(
        wish.kind,
        wish.mode,
        tuple(fit.segment(offset, amplitude, periods, settle) for offset, fit in zip(each, cycle(fits))),
        limits,
        guess,
    )


@dataclass(frozen=True)
class _FittedShape:
    """Shape of peak 1, with its peaks of speed and torque for the comparison with the limits."""

    shape: Shape
    period_s: float
    limits: MotionLimits
    guess: RigGuess
    mode: DriveMode
    up: float            # speed above and below its mean, per unit of amplitude
    down: float
    torque_up: float     # torque above and below its mean, N·m per rad/s of amplitude
    torque_down: float
    foreseen: float      # as ``up``, for the speed that the guard predicts
    steepest: float      # largest acceleration, rad/s² per rad/s of amplitude

    @classmethod
    def of(cls, shape: Shape, period_s: float, limits: MotionLimits, guess: RigGuess,
           mode: DriveMode) -> "_FittedShape":
        following = guess.following if mode == "speed" else None
        moved = shape if following is None else shape.followed(period_s, following)
        speed = shape.deviation()
        ahead = shape.foreseen_deviation(period_s, limits.foresight_s if mode == "torque" else 0.0)
        torque = moved.torque_deviation(period_s, guess.inertia_kg_m2, guess.viscous_nm_s_rad)
        both = np.concatenate([speed, moved.deviation()])
        peaks = (float(np.max(both)), float(-np.min(both)), float(np.max(torque)), float(-np.min(torque)))
        steepest = float(np.max(np.abs(shape.steepness(period_s))))
        return cls(shape, period_s, limits, guess, mode, *peaks, max(peaks[0], float(np.max(ahead))), steepest)

    def around(self, others: "list[_FittedShape]") -> "_FittedShape":
        """Return this shape with the largest peaks of all realisations."""
        names = ("up", "down", "torque_up", "torque_down", "foreseen", "steepest")
        return replace(self, **{name: max(getattr(one, name) for one in (self, *others)) for name in names})

    @property
    def swing(self) -> float:
        return self.guess.speed_swing_factor(self.mode)

    @property
    def ramp_room(self) -> float:
        """Return the largest amplitude that the drive's own speed ramp permits, rad/s."""
        if self.mode == "torque" or math.isinf(self.limits.acceleration_rad_s2):
            return math.inf
        return RAMP_SHARE * self.limits.acceleration_rad_s2 / self.steepest

    def largest_at(self, offset_rad_s: float) -> tuple[float, str]:
        """Return the largest amplitude about a mean speed, rad/s, and the limit that determines it."""
        torque_factor = self.guess.torque_swing_factor(self.mode)
        steady = self.guess.steady_torque_nm(offset_rad_s)
        usable = self.limits.usable_torque_nm
        candidates = [
            ((self.limits.usable_high_rad_s - offset_rad_s) / (self.foreseen * self.swing), "speed window (upper end)"),
            ((offset_rad_s - self.limits.usable_low_rad_s) / (self.down * self.swing), "speed window (lower end)"),
            ((usable - steady) / (self.torque_up * torque_factor), "torque limit"),
            ((usable + steady) / (self.torque_down * torque_factor), "torque limit"),
        ]
        if self.mode == "torque":
            candidates.append(((steady - self.limits.least_torque_nm) / self.torque_down, "no braking torque"))
        candidates.append((self.ramp_room, f"the drive's speed ramp ({self.limits.acceleration_rad_s2:.3g} rad/s²)"))
        most = min(candidates, key=lambda candidate: candidate[0])
        if self.mode == "speed" or self._never_backwards(offset_rad_s, most[0]):
            return most
        low, high = 0.0, most[0]
        while high - low > 1e-3 * most[0]:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if self._never_backwards(offset_rad_s, middle) else (low, middle)
        return low, "standstill (as far ahead as the guard looks)"

    def _never_backwards(self, offset_rad_s: float, amplitude_rad_s: float) -> bool:
        """Return whether the guard predicts no reverse rotation (`Guard.predicted_speed`) with the plan's torque."""
        foresight_s, guess = self.limits.foresight_s, self.guess
        swung = amplitude_rad_s * self.swing
        speed = offset_rad_s + swung * self.shape.deviation()
        rate = swung * self.shape.steepness(self.period_s)
        torque = guess.steady_torque_nm(offset_rad_s) + amplitude_rad_s * self.shape.torque_deviation(
            self.period_s, guess.inertia_kg_m2, guess.viscous_nm_s_rad
        )
        push = torque + guess.coulomb_nm
        passes = (speed + foresight_s * rate < 0.0) & (push < 0.0)
        beyond = push[passes] / guess.inertia_kg_m2 * (foresight_s + speed[passes] / rate[passes])
        return bool(np.all(beyond >= -_BACKWARDS_SHARE * self.limits.speed_high_rad_s))

    def segment(self, offset_rad_s: float, amplitude_rad_s: float, periods: int, settle: int) -> PlannedSegment:
        reference = PeriodicReference(
            offset_rad_s=offset_rad_s,
            period_s=self.period_s,
            lines_hz=tuple(harmonic / self.period_s for harmonic in self.shape.harmonics),
            amplitudes_rad_s=tuple(amplitude_rad_s * a for a in self.shape.amplitudes),
            phases_rad=self.shape.phases_rad,
            guess=self.guess,
        )
        return PlannedSegment(
            reference=reference,
            periods=periods,
            settle_periods=settle,
            speed_min_rad_s=offset_rad_s - amplitude_rad_s * self.down,
            speed_max_rad_s=offset_rad_s + amplitude_rad_s * self.up,
            torque_min_nm=reference.mean_torque_nm - amplitude_rad_s * self.torque_down,
            torque_max_nm=reference.mean_torque_nm + amplitude_rad_s * self.torque_up,
        )


def periodic_kind(name: str) -> PeriodicKind:
    """Return the periodic kind of that name. Raises PlanRefused if it is not periodic."""
    kind = excitation_kind(name)
    if not isinstance(kind, PeriodicKind):
        raise PlanRefused(f"{name} is not a periodic excitation")
    return kind


def settling_periods(period_s: float, settle_s: float = SETTLE_S) -> int:
    """Return the number of settling periods."""
    return max(1, math.ceil(settle_s / period_s - 1e-9))


def _periods(wish: PlanRequest, period_s: float, settle: int) -> int:
    if wish.periods is not None:
        if wish.periods < settle + 1:
            raise PlanRefused(
                f"{wish.periods} periods are too few where {settle} of them settle",
                f"Give --periods {settle + 1} or more",
            )
        return wish.periods
    at_one_speed_s = periodic_kind(wish.kind).at_one_speed_s
    if at_one_speed_s > 0.0:
        return settle + max(10, math.ceil(at_one_speed_s / period_s - 1e-9))
    # as long as the default multisine, but at least six evaluated periods: their scatter sets the weights
    # in all realisations together
    counted = (signals.DEFAULT_PERIODS - 1) / signals.MULTISINE_FREQUENCY_HZ / wish.realisations
    return settle + max(math.ceil(LEAST_COUNTED / wish.realisations), math.ceil(counted / period_s - 1e-9))


def _amplitude_and_offsets(fits: list[_FittedShape], wish: PlanRequest) -> tuple[float, tuple[float, ...]]:
    if wish.amplitude_rad_s is not None and not (math.isfinite(wish.amplitude_rad_s) and wish.amplitude_rad_s > 0.0):
        raise PlanRefused(f"amplitude must be positive, not {wish.amplitude_rad_s:g} rad/s")
    if wish.offsets_rad_s is not None and not wish.offsets_rad_s:
        raise PlanRefused("at least one offset is needed")
    offsets = wish.offsets_rad_s or _default_offsets(fits[0].around(fits[1:]), wish)
    largest, limit, where = min((*fit.largest_at(offset), offset) for offset in offsets for fit in fits)
    low, high = fits[0].limits.usable_low_rad_s, fits[0].limits.usable_high_rad_s
    window = f". A plan uses {in_rad_s_and_rpm(low, high)}" if limit.startswith("speed window") else ""
    if largest <= 0.0:
        advice = rpm_advice(where, OPTION["offset_rad_s"].flag, low, high) if wish.offsets_rad_s else "Change"
        raise PlanRefused(f"{limit} leaves no room for any excitation at {in_rad_s_and_rpm(where)}{window}",
                          USUAL_STEP.replace("Change", advice))
    amplitude = largest if wish.amplitude_rad_s is None else wish.amplitude_rad_s
    if amplitude > largest * (1.0 + 1e-9):
        raise PlanRefused(
            f"{limit}: an amplitude of {in_rad_s_and_rpm(amplitude)} at {in_rad_s_and_rpm(where)} does not fit; "
            f"{in_rad_s_and_rpm(largest)} would fit{window}",
            USUAL_STEP.replace("Change", rpm_advice(amplitude, OPTION["amplitude_rad_s"].flag, 0.0, largest)),
        )
    return amplitude, tuple(offsets)


def _default_offsets(fit: _FittedShape, wish: PlanRequest) -> tuple[float, ...]:
    """Return two mean speeds (one if the slope of friction is not needed), as far apart as the amplitude allows.

    The amplitude is limited by the window without the least distance of the mean speeds, by the torque limit, and by
    the drive's own ramp. The rest of the window increases the distance, which determines B.
    """
    low, high = fit.limits.usable_low_rad_s, fit.limits.usable_high_rad_s
    span = (fit.foreseen + fit.down) * fit.swing
    if periodic_kind(wish.kind).at_one_speed_s > 0.0:
        return (low + (high - low) * fit.down / (fit.foreseen + fit.down),)
    share = _OFFSET_SHARE if wish.offset_share is None else wish.offset_share
    amplitude = (1.0 - share) * (high - low) / span
    torque_room = fit.limits.usable_torque_nm - max(fit.guess.steady_torque_nm(low), fit.guess.steady_torque_nm(high))
    torque_swing = max(fit.torque_up, fit.torque_down) * fit.guess.torque_swing_factor(fit.mode)
    if torque_room <= 0.0:
        raise PlanRefused(
            f"torque limit: steady friction leaves nothing of the {fit.limits.usable_torque_nm:g} N·m "
            "that a plan may use"
        )
    amplitude = min(amplitude, torque_room / torque_swing, fit.ramp_room)
    if wish.amplitude_rad_s is not None:
        amplitude = min(amplitude, wish.amplitude_rad_s) if wish.amplitude_rad_s > 0.0 else amplitude
    first = low + amplitude * fit.down * fit.swing
    second = high - amplitude * fit.foreseen * fit.swing
    return first, second
