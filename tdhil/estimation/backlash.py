r"""Backlash: the play of a coupling or a gear behind the motor, found in the reported angle of the shaft.

The load is driven by one flank while the torque on it has one sign, and by the other flank after this torque has
reversed. With the play p, the inertias J_r of the motor and J_L of the load, J = J_r + J_L, and x the angle of the
motor before that of the load, −p/2 ≤ x ≤ p/2,

    J_r θ_r'' = u − T_r − τ,   J_L θ_L'' = τ − T_L    ⟹    θ_r = θ_J + y,   y = (J_L/J) x,   J θ_J'' = u − T_r − T_L.

θ_J is the angle of a rigid shaft under the same torque u, and y is what the play adds to the reported angle. Between
the flanks τ is 0 and T_L slows the load down, so

    x'' = (u − T_r)/J_r + T_L/J_L = (J/J_r) (θ_J'' + a),    a = T_L/J_L = a₀ + b ω.

At a flank the load rebounds with the share e of its speed, or x rests there. In units of y's largest value
η = (J_L/J) p/2, z = y/η moves within ±1:

    z'' = λ (θ_J'' + a),   λ = J_L/(J_r η),   p = 2 (η + 1/λ).

η is the part of the play that the motor's sensor sees, λ follows from the time that the motor needs from flank to
flank, and a from the instants at which it leaves a flank.

A linear shaft has no angle at harmonics of the period that are not excited, apart from what its torque does there. So
the reported angle less T/(J s²) of the reported torque, averaged over the periods, is η z at these harmonics, and
noise. T has the filter of the reported torque taken out. The play may have bent the filter that was fitted, so the
torque as reported is tried too, and what leaves less of the angle counts. J is roughly |T|/|s² θ| at the lowest excited
line. Its error makes no angle there on average.
Nonlinear friction and reports that repeat leave an angle too, with another pattern. It is taken as random, with a
variance that falls with a power of the frequency. The backlash must explain more than any such variance does.

A motion that decays over the periods, such as the swing of a string after a change of its mean speed, is not periodic.
By parts, its line at ω is a sum of its jumps from the start to the end of a period: Δx/(j ω), Δx'/(j ω)², Δx''/(j ω)³
and so on, each over the period. They are real and common to all harmonics, so that the first three of them leave both
the rest and z by least squares. Without this, a string got a play of 16 mrad that it does not have.

Nothing is found if the torque on the load does not reverse: the play is then never crossed, and does not disturb J.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from profiles import CodedText, MessageCode
from profiles.quantities import printed_interval
from tdhil.estimation.case import Finding, PeriodicCase
from tdhil.estimation.frequency_domain import ModelCurve, filters
from tdhil.estimation.line_influence import LEAST_PERIODS, inertia_changes, segment_means, widened
from tdhil.estimation.result import Backlash, Estimate, PlayMotion, Refusal, normal_quantile
from tdhil.estimation.samples import Samples, Stretch, angle_readings, thinned
from tdhil.estimation.spectrum import ComplexArray, unit_waves
from tdhil.recording import FloatArray, IntArray, Segment

LEAST_GAIN = 60.0
"""Least decrease of −2 ln L by a backlash. `benchmarks/backlash.py` has the largest gain of 500 shafts without one."""

_ADVICE = "remove the backlash, or raise --offset until the torque on the load keeps its sign"
_SMALLEST_SHARE = 0.05    # least explained share that counts
_LEAST_EXPLAINED = 0.6    # share of the angle beyond noise; below it the size of the play is open
_FIRST_GAIN = 12.0        # least gain on the coarse grid, for a fit
_MODEL_REL = 0.2          # relative half-width for flanks that yield or rebound; `benchmarks/backlash.py`
_BEYOND = 12              # times the highest excited harmonic: highest harmonic used
_MOST_HARMONICS = 80      # highest harmonic used, unless an excited one is above a half of it
_LEAST_BEYOND = 2         # times the highest excited harmonic: fewest harmonics used
_TRANSIENT_TERMS = 3      # powers of 1/(j ω) of a decaying motion; the next one is 1 % of the first at 5 times its rate
_READINGS = 5             # readings of the angle for one harmonic, at least
_POINTS = 8               # points for one harmonic that are kept of a recording with more
_SAME_PERIODS = 1e-9      # periods; instants closer than this are the same: 1e-7 of a turn of the highest harmonic
_NO_ANGLE_RAD = 1e-15     # rad; far below any reading, so that an angle of 0 has a logarithm
_NEIGHBOURS = 7           # harmonics on either side, over which the scatter is smoothed
_STEPS = 1000             # steps of a period in which the motion between the flanks is computed
_COARSE_STEPS = 400       # the same on the coarse grid
_SLOPES = (1, 2, 3, 4)    # powers of 1/frequency of the angle that other distortion leaves
_LEVELS = np.concatenate(([0.0], np.geomspace(1e-2, 1e5, 15)))
"""Variances of this distortion at the lowest harmonic, over that of the noise."""
_CROSSINGS = np.geomspace(0.01, 0.476, 7)
"""Times from flank to flank on the grid, in periods of the highest excited line."""
_LEAVINGS = np.linspace(0.03, 0.97, 17)
"""Values of a on the grid, in units of the largest deceleration: outside of 0 to 1 no torque reverses."""
_VISCOUS = (0.0, 0.5, 1.0)
"""Shares of b ω in a on the grid, at the mean speed."""
_REBOUNDS = (0.0, 0.4, 0.7)    # e on the grid
_MOST_REBOUND = 0.75      # largest e; a damping ratio of 9 % of the closed coupling
_PASSES = 2               # passes of the grid, after the first look
_ROUNDS = 12              # steps of a fit
_STEP = np.array([0.02, 0.01, 0.003, 0.02])
"""Steps of ln λ, of a in units of the largest deceleration, of b, 1/s, and of e, for the slopes of a fit."""
_LARGEST_STEP = np.array([0.7, 0.15, 0.1, 0.2])
"""Largest step of a fit, in the same units."""


_Lines = tuple[ComplexArray, ...]
"""Lines at the excited harmonics of C candidates, (K, C) for each segment."""


@dataclass(frozen=True)
class _SegmentAngle:
    """Angle of one segment at H harmonics of its period, means over P periods.

    ``theta`` (H,): the reported angle, rad; ``rest`` (U,): that at the unexcited harmonics ``unexcited`` (U,), without
    the part that the reported torque explains, and without a decaying motion; ``variance`` (U,): E|·|² of its noise.
    """

    period_s: float
    offset_rad_s: float
    excited: tuple[int, ...]
    theta: ComplexArray
    unexcited: FloatArray
    rest: ComplexArray
    variance: FloatArray

    def motion(self, steps: int, play: ComplexArray) -> tuple[FloatArray, FloatArray]:
        """Return acceleration and speed of the rigid shaft over one period, (steps + 1, C) each.

        ``play`` (K, C): y of C candidates at the excited harmonics, which is no motion of the rigid shaft.
        """
        theta = self.theta[self.places, None] - play
        s = (2j * math.pi * np.array(self.excited) / self.period_s)[:, None]
        turned = np.exp(np.multiply.outer(np.linspace(0.0, self.period_s, steps + 1), s[:, 0]))
        return (turned @ (s**2 * theta)).real, self.offset_rad_s + (turned @ (s * theta)).real

    def settled(self, lines: ComplexArray) -> ComplexArray:
        """Return lines (C, U) at the unexcited harmonics without what a decaying motion may leave there."""
        decaying = (1j * self.unexcited) ** -np.arange(1.0, _TRANSIENT_TERMS + 1.0)[:, None]
        weighted = decaying.conj() / self.variance
        parts = (weighted @ lines.T).real
        kept: ComplexArray = lines - np.linalg.solve((weighted @ decaying.T).real, parts).T @ decaying
        return kept

    @property
    def places(self) -> IntArray:
        """Return the places (K,) of the excited harmonics."""
        return np.array(self.excited) - 1


@dataclass(frozen=True)
class _GapMotion:
    """C candidates of the motion between the flanks: ln λ, a₀, rad/s², b, 1/s, and e; (C,) each."""

    log_rate: FloatArray
    leaving: FloatArray
    slope: FloatArray
    rebound: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> _GapMotion:
        """Return the candidates of a table (C, 4)."""
        return cls(*rows.T)

    def waves(self, segment: _SegmentAngle, steps: int, play: ComplexArray) -> ComplexArray:
        """Return the lines (C, H) of z at all harmonics of a segment, in its second period."""
        acceleration, speed = segment.motion(steps, play)
        drive = acceleration + self.leaving + self.slope * speed
        drive = 0.5 * (drive[1:] + drive[:-1]) * np.exp(self.log_rate)
        dt = segment.period_s / steps
        moved, gained = 0.5 * dt**2 * drive, dt * drive
        place, rate = np.ones(len(self.slope)), np.zeros(len(self.slope))
        seen = np.empty((steps, len(place)))
        # what a step gains against the flank is no speed to rebound with
        least, kept = 2.0 * np.abs(gained), -self.rebound
        for _ in range(2):
            for now, move, gain, rebounds in zip(seen, moved, gained, least, strict=True):
                now[:] = place
                place = place + dt * rate + move
                rate = rate + gain
                hit = np.abs(place) >= 1.0
                rate = np.where(hit, np.where(np.abs(rate) > rebounds, kept * rate, 0.0), rate)
                place = np.minimum(np.maximum(place, -1.0), 1.0)
        lines: ComplexArray = np.fft.rfft(seen, axis=0)[1 : len(segment.theta) + 1].T * (2.0 / steps)
        return lines


@dataclass(frozen=True)
class _PlayLikelihood:
    """−2 ln L of C candidates (C,), with η (C,) of each, rad, and the variance (C, U) of all that is left."""

    value: FloatArray
    size: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class _AllSegments:
    """All segments, their unexcited harmonics in one row."""

    segments: tuple[_SegmentAngle, ...]

    @property
    def rest(self) -> ComplexArray:
        return np.concatenate([one.rest for one in self.segments])

    @property
    def still(self) -> _Lines:
        """Return no play at the excited harmonics, (K, 1) of each segment."""
        return tuple(np.zeros((len(one.excited), 1), dtype=np.complex128) for one in self.segments)

    def waves(self, rows: FloatArray, steps: int, play: _Lines) -> tuple[ComplexArray, _Lines]:
        """Return z of candidates (C, 4) at the unexcited harmonics (C, U), and at the excited ones, (K, C) of each
        segment. ``play``: y at the excited harmonics, as far as it is known.
        """
        found = [_GapMotion.of(rows).waves(one, steps, own) for one, own in zip(self.segments, play, strict=True)]
        free = [one.settled(lines[:, one.unexcited.astype(np.int64) - 1])
                for one, lines in zip(self.segments, found, strict=True)]
        excited = tuple(lines[:, one.places].T for one, lines in zip(self.segments, found, strict=True))
        return np.concatenate(free, axis=1), excited

    def explained(self, angle: ComplexArray) -> float:
        """Return the share of the rest beyond noise, in power, that an angle (U,) explains, at the most 1."""
        noise = np.concatenate([one.variance for one in self.segments])
        before, after = (float(np.sum(np.abs(rest) ** 2 / noise)) for rest in (self.rest, self.rest - angle))
        return min(1.0, (before - after) / max(before - len(noise), 1e-300))

    def likelihood(self, z: ComplexArray | None) -> _PlayLikelihood:
        """Return the likelihood of candidates with z (C, U), or without backlash; at the best η and distortion."""
        rest, noise = self.rest, np.concatenate([one.variance for one in self.segments])
        harmonics = np.concatenate([one.unexcited for one in self.segments])
        lowest = int(np.argmin(harmonics))
        falling = (harmonics / harmonics[lowest]) ** (-2.0 * np.array(_SLOPES)[:, None])
        variance = noise + np.reshape(noise[lowest] * _LEVELS[:, None] * falling[:, None], (-1, len(rest)))
        value = 2.0 * np.sum(np.log(variance) + np.abs(rest) ** 2 / variance, axis=1)[None]
        size = np.zeros_like(value)
        if z is not None:
            energy, product = (part @ (1.0 / variance).T for part in (np.abs(z) ** 2, (z.conj() * rest).real))
            size = np.maximum(product / (energy + 1e-300), 0.0)
            value = value - 2.0 * size**2 * energy
        best = np.argmin(value, axis=1)
        rows = np.arange(len(best))
        return _PlayLikelihood(value[rows, best], size[rows, best], variance[best])


@dataclass(frozen=True)
class _FittedBacklash:
    """A backlash: ``row`` (4,) of `_GapMotion`, η, rad, the decrease of −2 ln L, and the covariance (5, 5) of ln η and
    the row. ``play``: y at the excited harmonics, (K, 1) of each segment. ``explained``: share of the angle beyond
    noise, in power, that the play explains.
    """

    row: FloatArray
    size: float
    gain: float
    covariance: FloatArray
    play: _Lines
    explained: float

    def estimate(self, confidence: float) -> Backlash:
        """Return the play and its visible part with their intervals, if they are known."""
        if self.explained < _LEAST_EXPLAINED:
            return Backlash(play_rad=None, at_motor_rad=None)
        width = normal_quantile(confidence)
        hidden = math.exp(-float(self.row[0]))
        play = 2.0 * (self.size + hidden)
        slope = np.array([self.size, -hidden]) * 2.0 / play
        own = self.covariance[:2, :2]
        parts = (play, math.sqrt(max(float(slope @ own @ slope), 0.0))), (
            2.0 * self.size, math.sqrt(max(float(own[0, 0]), 0.0)))
        found = []
        for value, sd in parts:
            factor = math.exp(math.hypot(width * sd, _MODEL_REL))
            found.append(Estimate(value, value / factor, value * factor))
        return Backlash(play_rad=found[0], at_motor_rad=found[1])


def with_backlash(case: PeriodicCase, finding: Finding) -> Finding:
    """Return the finding with the backlash of the coupling behind the motor, and its part in the uncertainty of J.

    Without a reported angle, or with too few periods, the finding is returned unchanged.
    """
    readings = angle_readings(case.recording)
    if readings is None:
        return finding
    segments = {number: one for number, stretch in enumerate(case.stretches)
                if (one := _angle_of(stretch, readings, finding)) is not None}
    if not segments:
        return finding
    fitted = _fitted(_AllSegments(tuple(segments.values())))
    finding = replace(finding, backlash_motion=_play_motion(case))
    if fitted is None:
        return replace(finding, backlash=())
    found = fitted.estimate(case.options.confidence)
    return _widened(replace(finding, backlash=(found,)), case, segments, fitted, found)


def _play_motion(case: PeriodicCase) -> PlayMotion:
    """Return the least torque of the excited motion along the rotation, by its lines."""
    least = []
    for stretch, fit in zip(case.stretches, case.fits, strict=True):
        if len(fit.torque):
            time = np.linspace(0.0, stretch.segment.period_s, _STEPS)
            waves = unit_waves(2.0 * np.pi * np.multiply.outer(time, np.array(fit.lines_hz)))
            torque = fit.torque_mean.mean() + (waves @ fit.torque.mean(axis=0)).real
            least.append(float(np.min(torque * np.sign(fit.speed_mean.mean()))))
    return PlayMotion(min(least) < 0.0, min(least))


def _widened(
    finding: Finding, case: PeriodicCase, segments: dict[int, _SegmentAngle], fitted: _FittedBacklash, found: Backlash
) -> Finding:
    """Return the finding with a warning, and with the change of J by the play in the excited lines as a half-width."""
    text = "backlash: the coupling or gear behind the motor has a play"
    if (angle := found.play_rad) is not None:
        ends = printed_interval(1e3 * angle.low, 1e3 * angle.high, 3)
        text += f" of {1e3 * angle.value:.3g} mrad at the motor shaft ({ends})"
    else:
        text += ", whose size these data do not give"
    if finding.compliant is not None:
        return finding.taken_back(
            Refusal(f"{text}; a linear spring does not describe it", _ADVICE, MessageCode.BACKLASH_FOUND))
    half = _change(finding, case, segments, fitted, found)
    if finding.inertia is None or half is None:
        return replace(finding, words=replace(finding.words, if_rejected=_ADVICE),
                       warnings=(*finding.warnings, CodedText(text, MessageCode.BACKLASH_FOUND)))
    text = f"{text}; it widens J by {100 * half / finding.inertia.value:.2f} %"
    return widened(
        replace(finding, warnings=(*finding.warnings, CodedText(text, MessageCode.BACKLASH_FOUND))), half, "backlash",
        "its change of the excited lines")


def _change(
    finding: Finding, case: PeriodicCase, segments: dict[int, _SegmentAngle], fitted: _FittedBacklash, found: Backlash
) -> float | None:
    """Return the change of J by the play, at the largest size that its interval allows; None without a model.

    The reported speed contains F_w s y. To first order its error is that of a torque −Z F_w s y, with Z the reported
    T/ω. A play that the model explains in part is taken as large as all of the angle beyond noise.
    """
    if not isinstance(finding.curve, ModelCurve):
        return None
    model, theta = finding.curve.fitted.problem.model, finding.curve.fitted.likelier.theta
    most = 1.0 / math.sqrt(max(fitted.explained, _SMALLEST_SHARE))
    if found.at_motor_rad is not None:
        most = max(most, found.at_motor_rad.high / found.at_motor_rad.value)
    by_segment = {}
    for (number, segment), play in zip(segments.items(), fitted.play, strict=True):
        s: ComplexArray = np.asarray(2j * np.pi * np.array(segment.excited) / segment.period_s, dtype=np.complex128)
        speed = filters(theta[model.mechanical :], s)[0] * s * play[:, 0]
        by_segment[number] = -(model.impedance(theta, s) * speed)[None]
    rows = segment_means(case, finding.curve, by_segment)
    # the parts of the lines do not cancel: the flanks of the model are not those of the coupling
    return most * float(np.linalg.norm(inertia_changes(finding.curve, theta, rows))) if rows else None


# ---------------------------------------------------------------------------------------------------------------------
# The angle at the harmonics of the period


def _angle_of(
    stretch: Stretch, readings: tuple[FloatArray, FloatArray], finding: Finding
) -> _SegmentAngle | None:
    """Return the angle of a segment; None for too few periods or too few readings."""
    segment, (time, turned) = stretch.segment, readings
    if len(stretch.periods) < LEAST_PERIODS:
        return None
    begins = [segment.start_s + number * segment.period_s for number in stretch.index]
    spans = [np.searchsorted(time, (begin - 1e-9, begin + segment.period_s - 1e-9)) for begin in begins]
    excited = tuple(round(hertz * segment.period_s) for hertz in segment.lines_hz)
    highest = max(_LEAST_BEYOND * max(excited), min(_BEYOND * max(excited), _MOST_HARMONICS))
    highest = min(highest, min(int(last - first) for first, last in spans) // _READINGS)
    if highest <= max(excited):
        return None
    harmonics = np.arange(1.0, highest + 1.0)
    table = _lines([(time[first:last], turned[first:last]) for first, last in spans], segment, highest)
    torque = _lines([(period.time_s, period.torque_nm) for period in stretch.periods], segment, highest)
    s: ComplexArray = np.asarray(2j * np.pi * harmonics / segment.period_s, dtype=np.complex128)
    lowest = min(excited) - 1
    rough = abs(complex(torque[:, lowest].mean() / (s[lowest] ** 2 * table[:, lowest].mean())))
    free = ~np.isin(harmonics, excited)
    through = [np.ones_like(s)]      # the filter of the reported torque: none, or that of a fitted model
    if isinstance(finding.curve, ModelCurve):
        fitted = finding.curve.fitted
        through.append(filters(fitted.likelier.theta[fitted.problem.model.mechanical :], s)[1])
    # A play bends the fitted filter: the one that leaves less of the angle counts.
    rest = min((table - torque / (one * s**2 * rough) for one in through),
               key=lambda rest: float(np.mean(np.log(np.abs(rest.mean(axis=0)[free]) + _NO_ANGLE_RAD))))
    mean = rest.mean(axis=0)
    scatter = np.sum(np.abs(rest - mean) ** 2, axis=0)[free] / (len(rest) - 1)
    seen = _SegmentAngle(
        segment.period_s, segment.offset_rad_s, excited, table.mean(axis=0), harmonics[free], mean[free],
        _smoothed(harmonics[free], scatter, len(rest) - 1) / len(rest))
    return replace(seen, rest=seen.settled(seen.rest[None])[0])


def _lines(periods: Sequence[tuple[FloatArray, FloatArray]], segment: Segment, highest: int) -> ComplexArray:
    """Return the lines (P, H) of time and signal of P periods, by least squares beside a parabola. Their phases are
    from the start of the segment.
    """
    alike: list[tuple[FloatArray, list[FloatArray]]] = []      # periods of a uniform recording have the same equations
    for time, signal in periods:
        thin = thinned(Samples(time, signal, np.zeros(len(time))), _POINTS * highest)
        turn = (thin.time_s - segment.start_s) / segment.period_s
        turn -= math.floor(turn[len(turn) // 2])
        if not alike or len(turn) != len(alike[-1][0]) or np.max(np.abs(turn - alike[-1][0])) > _SAME_PERIODS:
            alike.append((turn, []))
        # the angle grows by many turns in a period: without its mean the normal equations are accurate
        alike[-1][1].append(thin.speed_rad_s - thin.speed_rad_s.mean())
    found = []
    for turn, signals in alike:
        place = turn - 0.5 * (turn[0] + turn[-1])
        angle = np.multiply.outer(2.0 * math.pi * turn, np.arange(1.0, highest + 1.0))
        design = np.column_stack([np.ones(len(turn)), place, place**2 - 1.0 / 12.0, np.cos(angle), np.sin(angle)])
        solution = np.linalg.solve(design.T @ design, design.T @ np.array(signals).T).T
        found.append(solution[:, 3 : 3 + highest] - 1j * solution[:, 3 + highest :])
    return np.concatenate(found)


def _smoothed(harmonics: FloatArray, scatter: FloatArray, freedom: int) -> FloatArray:
    """Return the scatter (U,) smoothed over its neighbours, by a straight line in logarithms.

    The mean of ln(χ²/n) is below 0. It is ψ(n/2) − ln(n/2), nearly −1/n − 1/(3 n²), with n = 2 ``freedom`` here.
    """
    degrees = 2.0 * freedom
    logarithm = np.log(np.maximum(scatter, 1e-300)) + 1.0 / degrees + 1.0 / (3.0 * degrees**2)
    place = np.log(harmonics)
    found = np.empty(len(place))
    for k in range(len(place)):
        near = slice(max(0, k - _NEIGHBOURS), k + _NEIGHBOURS + 1)
        design = np.column_stack([np.ones(len(place[near])), place[near] - place[k]])
        found[k] = np.linalg.lstsq(design, logarithm[near], rcond=None)[0][0]
    smooth: FloatArray = np.exp(found)
    return smooth


# ---------------------------------------------------------------------------------------------------------------------
# The fit


def _fitted(seen: _AllSegments) -> _FittedBacklash | None:
    """Return the likeliest backlash; None if it does not explain more than other distortion would."""
    without = float(seen.likelihood(None).value[0])
    motions = [one.motion(_COARSE_STEPS, still)[0][:, 0] for one, still in zip(seen.segments, seen.still, strict=True)]
    largest = -min(float(motion.min()) for motion in motions)
    if not largest > 0.0:
        return None
    rows = _grid(seen, motions, largest)
    z, excited = seen.waves(rows, _COARSE_STEPS, seen.still)
    coarse = seen.likelihood(z)
    if without - float(coarse.value.min()) < _FIRST_GAIN:
        return None
    # a large play is also a large part of the excited lines: each candidate subtracts its own
    for _ in range(_PASSES):
        z, excited = seen.waves(rows, _COARSE_STEPS, tuple(coarse.size * own for own in excited))
        coarse = seen.likelihood(z)
    # The likeliest candidates of the grid for each time from flank to flank, rebound and share of b ω. From a few
    # starts alone, a fit may end beside the likeliest backlash: rebound and time from flank to flank trade.
    kinds = len(_VISCOUS) * len(_REBOUNDS)
    table = coarse.value.reshape(len(_CROSSINGS), len(_LEAVINGS), kinds)
    place = np.ravel_multi_index(
        (np.arange(len(_CROSSINGS))[:, None], np.argmin(table, axis=1), np.arange(kinds)), table.shape)
    return _descended(seen, rows[place.ravel()], largest, without)


def _grid(seen: _AllSegments, motions: list[FloatArray], largest: float) -> FloatArray:
    """Return the candidates of the first look, (C, 4)."""
    jerk = float(np.mean([np.mean(np.abs(np.diff(motion))) * len(motion) / one.period_s
                          for motion, one in zip(motions, seen.segments, strict=True)]))
    fastest_s = min(one.period_s / max(one.excited) for one in seen.segments)
    # a mean jerk j crosses the gap of 2 in the time t with 2 = λ j t³/6
    rates = np.log(12.0 / (jerk * (_CROSSINGS * fastest_s) ** 3))
    mean_rad_s = float(np.mean([abs(one.offset_rad_s) for one in seen.segments]))
    return np.array([
        (rate, (1.0 - share) * leaving * largest, share * leaving * largest / mean_rad_s if share else 0.0, rebound)
        for rate, leaving, share, rebound in itertools.product(rates, _LEAVINGS, _VISCOUS, _REBOUNDS)
        if mean_rad_s > 0.0 or not share])


def _descended(seen: _AllSegments, rows: FloatArray, largest: float, without: float) -> _FittedBacklash | None:
    """Return the likeliest backlash that Levenberg and Marquardt's steps find from any of the starts (C, 4).

    The play is also in the excited lines of the angle. Each step subtracts it there, as it is known so far.
    ``without``: −2 ln L without backlash. None if the play lowers it too little.
    """
    unit = np.array([1.0, largest, 1.0, 1.0])
    damping = np.full(len(rows), 1e-2)
    play = tuple(np.repeat(one, len(rows), axis=1) for one in seen.still)
    for _ in range(_ROUNDS):
        z, columns, excited = _slopes(seen, rows, unit, play)
        now = seen.likelihood(z)
        tried = rows.copy()
        for c in range(len(rows)):
            normal, right = _normal(columns[c], now.size[c], now.variance[c], seen.rest - now.size[c] * z[c])
            normal += np.diag(damping[c] * np.diag(normal) + 1e-12 * float(np.trace(normal)) + 1e-300)
            tried[c] += np.clip(np.linalg.solve(normal, right)[1:], -_LARGEST_STEP * unit, _LARGEST_STEP * unit)
        tried[:, 3] = np.clip(tried[:, 3], 0.0, _MOST_REBOUND)
        z_tried, excited_tried = seen.waves(tried, _STEPS, play)
        after = seen.likelihood(z_tried)
        better = after.value < now.value
        damping = np.where(better, 0.3 * damping, 10.0 * damping)
        rows = np.where(better[:, None], tried, rows)
        size = np.where(better, after.size, now.size)
        play = tuple(size * np.where(better, one, own) for one, own in zip(excited_tried, excited, strict=True))
    z, columns, _ = _slopes(seen, rows, unit, play)
    end = seen.likelihood(z)
    best = int(np.argmin(end.value))
    gain, last = without - float(end.value[best]), float(end.size[best])
    if gain < LEAST_GAIN or not last > 0.0:
        return None
    normal, _ = _normal(columns[best] * np.array([last, 1.0, 1.0, 1.0, 1.0])[:, None], last, end.variance[best],
                        seen.rest)
    covariance: FloatArray = np.asarray(np.linalg.pinv(2.0 * normal, hermitian=True), dtype=np.float64)
    return _FittedBacklash(rows[best], last, gain, covariance, tuple(one[:, best : best + 1] for one in play),
                           seen.explained(last * z[best]))


def _slopes(
    seen: _AllSegments, rows: FloatArray, unit: FloatArray, play: _Lines
) -> tuple[ComplexArray, ComplexArray, _Lines]:
    """Return z (C, U); z again and its slopes over the four quantities of a row, (C, 5, U); z at the excited lines."""
    step, count = _STEP * unit, len(rows)
    tried = np.concatenate([rows, *(rows + sign * step * axis for axis in np.eye(4) for sign in (1.0, -1.0))])
    flat, excited = seen.waves(tried, _STEPS, tuple(np.tile(one, 9) for one in play))
    z = flat.reshape(9, count, -1)
    slopes = [(z[1 + 2 * k] - z[2 + 2 * k]) / (2.0 * step[k]) for k in range(4)]
    return z[0], np.stack([z[0], *slopes], axis=1), tuple(one[:, :count] for one in excited)


def _normal(
    columns: ComplexArray, size: float, variance: FloatArray, rest: ComplexArray
) -> tuple[FloatArray, FloatArray]:
    """Return the normal matrix (5, 5) and the right side (5,) of η and a row, for ``rest`` (U,).

    ``columns`` (5, U): z, and its slopes per unit of η.
    """
    design = np.concatenate([columns[:1], size * columns[1:]])
    return ((design.conj() / variance) @ design.T).real, ((design.conj() / variance) @ rest).real
