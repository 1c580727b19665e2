"""Endless random rigs, read as CSV traces: how far off, how wide, how often refused, and does the interval cover?

    python benchmarks/random_rigs.py [--rigs 300] [--records 1] [--first 0] [--cause stribeck] [--motion multisine]
                                     [--mixed] [--keep DIR] [--out records.jsonl]

Each rig is drawn from its own seed: J from 0.01 to 3000 kg·m², friction of one of several laws, what its drive makes of
its reports, how it is sampled, what disturbs it. `CAUSES` name what a rig has that makes identifying it hard; they take
turns. Each record is one of four motions: a declared multisine, and ramps, torque pulses and starts with coasting that
nobody declared. The full proof is `--rigs 200 --records 12`.

Independent of what it tests: the shaft is stepped by Heun's rule, the reports are filtered in the frequency domain, and
of tdhil only `tdhil.read` (CSV in) and `tdhil.identify` (document out) are used. Refused: no number came; covered: of
the rest; half-width over RMSE: near 2 where an interval is as wide as it must be.

The exit code is 1 if a miss rate is above 5 % beyond chance (one-sided 99 %, Clopper and Pearson): of all records, of
a cause, of a motion, or of a motion of a cause.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import tdhil

RPM = 2.0 * math.pi / 60.0
MOTIONS = ("multisine", "ramps", "pulses", "starts")
GOALS = {"multisine": (0.25, 0.8, 2.0, 1.3), "ramps": (0.35, 0.9, 2.0, 1.5), "pulses": (0.35, 0.9, 2.0, 1.5),
         "starts": (0.35, 1.0, 2.0, 1.5)}
SPEED, TORQUE, OFF = 0, 1, 2
MOST_MISSED = 0.05
COLUMNS = 64            # stepped side by side
BLOCK = 2000            # steps of noise drawn at once
MULTIPLES, PERIODS, SETTLE = (1, 2, 3, 5, 7, 10), 8, 1


@dataclass
class Report:
    """H(s) = Π 1/(1 + τ s) · (1 − e^(−w s))/(w s) · e^(−d s)."""

    poles: tuple[float, ...] = ()
    average: float = 0.0
    delay: float = 0.0


@dataclass
class Rig:
    """SI at the motor shaft; ``pace`` stretches time: of the motion, the loops and the longer lags."""

    number: int
    cause: str
    inertia: float
    top: float
    limit: float
    pace: float
    coulomb: tuple[float, float]       # forward, back
    viscous: float
    square: float
    bell: float
    bell_width: float
    speed_report: Report
    torque_report: Report
    rate: float
    jitter: float
    skew: float                        # torque is read so much later than speed
    speed_quantum: float
    torque_quantum: float
    load: float
    load_time: float
    ripple: float
    sensor: float
    speed_noise: float
    torque_noise: float
    reverses: bool
    mixed_with: str = ""

    @property
    def step(self) -> float:
        return 0.0025 * self.pace

    def friction(self, speed: float) -> float:
        """Return the friction torque at a positive speed, N·m."""
        return (self.coulomb[0] + self.viscous * speed + self.square * speed * speed
                + self.bell * math.exp(-((speed / self.bell_width) ** 2)))


# -- rigs ----------------------------------------------------------------------------------------------------


def draw(number: int, mixed: bool = False) -> Rig:
    """The rig of this number; its cause goes round. ``mixed``: a second cause, drawn at random, comes on top."""
    rng = np.random.default_rng([number, 20261])
    cause = CAUSES[number % len(CAUSES)]
    log_j = rng.uniform(math.log10(30.0), math.log10(3000.0)) if cause == "coarse" else rng.uniform(-2.0, 3.48)
    inertia = 10.0**log_j
    size = (log_j + 2.0) / 5.48
    pace = float(np.clip(0.3 + 0.9 * size, 0.3, 1.0)) * rng.uniform(0.85, 1.15)
    top = 10.0 ** (2.4 - 1.4 * size) * rng.uniform(0.7, 1.4)
    share = rng.uniform(0.1, 0.35)
    limit = inertia * top / (rng.uniform(1.2, 4.0) * pace) / (1.0 - share)
    whole = share * limit
    kind = rng.uniform(0.2, 0.8)
    coulomb, viscous = kind * whole, (1.0 - kind) * whole / top
    noisy = 10.0 ** rng.uniform(-0.5, 0.3)
    rig = Rig(
        number, cause, inertia, top, limit, pace, (coulomb, coulomb), viscous, 0.0, 0.0, 1.0,
        Report((rng.uniform(0.05, 0.5) * pace,)), Report((rng.uniform(0.02, 0.25) * pace,)),
        float(rng.choice([20.0, 50.0, 100.0])) / pace, 0.1, rng.uniform(-0.005, 0.005) * pace,
        float(rng.choice([0.0005, 0.001, 0.002])) * top, float(rng.choice([0.0005, 0.001, 0.005])) * limit,
        0.006 * noisy * limit, rng.uniform(0.3, 1.0) * pace, 0.02 * noisy * limit, 0.002 * noisy * top,
        0.0003 * noisy * top, 0.003 * noisy * limit, bool(rng.random() < 0.3),
    )
    CHANGES[cause](rig, rng)
    if mixed:
        second = CAUSES[int(np.random.default_rng([number, 20262]).integers(len(CAUSES)))]
        CHANGES[second](rig, rng)
        rig.mixed_with = second
    return rig


def _two(rng: np.random.Generator, low: float, high: float) -> tuple[float, float]:
    first = rng.uniform(low, high)
    return first, first * rng.uniform(0.95, 1.05)


def _short(rig: Rig, rng: np.random.Generator) -> None:
    first, second = _two(rng, 0.002, 0.015)
    rig.speed_report, rig.torque_report = Report((first,)), Report((second,))


def _matched(rig: Rig, rng: np.random.Generator) -> None:
    first, second = _two(rng, 0.4, 0.9)
    rig.speed_report, rig.torque_report = Report((first * rig.pace,)), Report((second * rig.pace,))


def _one_long(rig: Rig, rng: np.random.Generator) -> None:
    long, short = Report((rng.uniform(0.5, 0.9) * rig.pace,)), Report((rng.uniform(0.005, 0.05) * rig.pace,))
    rig.speed_report, rig.torque_report = (long, short) if rng.random() < 0.7 else (short, long)


def _three(rig: Rig, rng: np.random.Generator) -> None:
    rig.speed_report = Report(tuple(rng.uniform(0.08, 0.22, 3) * rig.pace))
    rig.torque_report = Report(tuple(rng.uniform(0.02, 0.15, int(rng.integers(1, 4))) * rig.pace))


def _averages(rig: Rig, rng: np.random.Generator) -> None:
    rig.speed_report = Report((rng.uniform(0.01, 0.1) * rig.pace,), rng.uniform(0.1, 0.5) * rig.pace)
    rig.torque_report = Report((), rng.uniform(0.05, 0.25) * rig.pace)


def _late(rig: Rig, rng: np.random.Generator) -> None:
    rig.speed_report = Report((rng.uniform(0.02, 0.2) * rig.pace,), 0.0, rng.uniform(0.05, 0.3) * rig.pace)


def _coarse(rig: Rig, rng: np.random.Generator) -> None:
    rig.rate, rig.speed_quantum = 10.0, RPM
    rig.sensor, rig.speed_noise = 0.002 * RPM, 0.02 * RPM


def _calm(rig: Rig, rng: np.random.Generator) -> None:
    rig.speed_quantum, rig.torque_quantum = rig.top / rng.uniform(100.0, 300.0), rig.limit / rng.uniform(100.0, 300.0)
    rig.load, rig.ripple = 0.2 * rig.load, 0.1 * rig.ripple
    rig.sensor, rig.speed_noise, rig.torque_noise = 0.05 * rig.sensor, 0.0, 0.1 * rig.torque_noise


def _skewed(rig: Rig, rng: np.random.Generator) -> None:
    rig.skew = float(rng.choice([-1.0, 1.0])) * rng.uniform(0.03, 0.09) * rig.pace
    rig.rate = float(rng.choice([10.0, 20.0])) / rig.pace


def _windage(rig: Rig, rng: np.random.Generator) -> None:
    whole = rig.viscous * rig.top
    part = rng.uniform(0.5, 1.0)
    rig.viscous, rig.square = (1.0 - part) * whole / rig.top, part * whole / rig.top**2
    rig.speed_report = Report((0.3 * rig.pace,))


def _stribeck(rig: Rig, rng: np.random.Generator) -> None:
    rig.bell, rig.bell_width = rng.uniform(0.2, 0.8) * rig.coulomb[0], rng.uniform(0.1, 0.4) * rig.top
    rig.speed_report, rig.torque_report = Report((rng.uniform(0.003, 0.01),)), Report((rng.uniform(0.003, 0.01),))


def _loaded(rig: Rig, rng: np.random.Generator) -> None:
    rig.load, rig.load_time = rng.uniform(0.02, 0.05) * rig.limit, rng.uniform(4.0, 15.0) * rig.pace


def _lopsided(rig: Rig, rng: np.random.Generator) -> None:
    rig.coulomb = (rig.coulomb[0], rig.coulomb[0] * rng.uniform(0.5, 0.8))
    rig.reverses = True


CHANGES = {
    "plain": lambda rig, rng: None, "short": _short, "matched": _matched, "one long": _one_long, "three poles": _three,
    "averages": _averages, "late": _late, "coarse": _coarse, "calm": _calm, "skewed": _skewed, "windage": _windage,
    "stribeck": _stribeck, "slow load": _loaded, "asymmetric": _lopsided,
}
CAUSES = tuple(CHANGES)


# -- motions -------------------------------------------------------------------------------------------------


@dataclass
class Script:
    """Request at every step, (steps,): controlled quantity, target speed, feed-forward torque."""

    regime: np.ndarray
    target: np.ndarray
    feed: np.ndarray
    segments: tuple[dict[str, object], ...] = ()


def multisine(rig: Rig, rng: np.random.Generator) -> Script:
    """Two mean speeds, six lines; under a torque mode with a slow loop on the mean, or under a speed loop."""
    period = 15.0 * rig.pace
    lead, join = 2.0 * rig.pace, 8.0 * rig.pace
    omega = 2.0 * np.pi * np.array(MULTIPLES) / period
    offsets = np.array([0.42, 0.68]) * rig.top
    phases = np.pi * np.arange(6) ** 2 / 6.0 + rng.uniform(-0.3, 0.3, 6)
    weights = 1.0 / np.sqrt(1.0 + (omega * rig.pace / 2.0) ** 2)
    fine = np.arange(2000) * period / 2000
    wave = np.cos(np.outer(fine, omega) + phases) @ weights
    rise = -np.sin(np.outer(fine, omega) + phases) @ (omega * weights)
    room = 0.75 * (rig.limit - rig.friction(offsets[1]))
    scale = min(0.24 * rig.top / np.max(np.abs(wave)), room / (rig.inertia * np.max(np.abs(rise))))
    length = PERIODS * period
    t = np.arange(round((lead + 2.0 * length + join + 1.0 * rig.pace) / rig.step)) * rig.step
    starts = (lead, lead + length + join)
    target, rate = np.empty(len(t)), np.zeros(len(t))
    for which, start in enumerate(starts):
        at = t - start
        part = (at >= -1e-9) if which else (at < length)
        turned = np.outer(np.maximum(at[part], 0.0), omega) + phases
        target[part] = offsets[which] + scale * (np.cos(turned) @ weights)
        rate[part] = np.where(at[part] > 0.0, -scale * (np.sin(turned) @ (omega * weights)), 0.0)
    between = (t >= lead + length) & (t < starts[1] - 1e-9)
    turn = 0.5 - 0.5 * np.cos(np.pi * (t[between] - lead - length) / join)
    target[between] = offsets[0] + (offsets[1] - offsets[0]) * turn + scale * float(wave[0])
    rough = rig.inertia * rng.uniform(0.87, 1.15)
    feed = rough * rate + np.vectorize(rig.friction)(target)
    regime = np.full(len(t), TORQUE if rng.random() < 0.6 else SPEED)
    segments = tuple(
        {"start_s": round(start, 9), "periods": PERIODS, "period_s": round(period, 9), "settle_periods": SETTLE,
         "offset_rad_s": round(float(offset), 6), "lines_hz": [m / round(period, 9) for m in MULTIPLES]}
        for start, offset in zip(starts, offsets, strict=True)
    )
    return Script(regime, target, feed, segments)


def _time(rig: Rig, seconds: float) -> np.ndarray:
    return np.arange(round(seconds * rig.pace / rig.step)) * rig.step / rig.pace


def ramps(rig: Rig, rng: np.random.Generator) -> Script:
    """Trapezoids and triangles of the speed command; through zero on rigs that reverse."""
    t = _time(rig, 120.0)
    knots, levels = [0.0], [0.4 * rig.top]
    while knots[-1] < 121.0:
        low = -1.0 if rig.reverses and rng.random() < 0.4 else 1.0
        level = low * rig.top * rng.uniform(0.15, 0.95)
        need = abs(level - levels[-1]) * rig.inertia / (0.6 * rig.limit) / rig.pace
        knots += [knots[-1] + need + rng.uniform(0.5, 4.0)]
        levels += [level]
        if rng.random() < 0.7:
            knots += [knots[-1] + rng.uniform(0.5, 3.0)]
            levels += [level]
    return Script(np.full(len(t), SPEED), np.interp(t, knots, levels), np.zeros(len(t)))


def pulses(rig: Rig, rng: np.random.Generator) -> Script:
    """A speed loop to a mean speed, then pairs of torque pulses, with friction's torque under them."""
    t = _time(rig, 120.0)
    middle = 0.55 * rig.top
    hold = rig.friction(middle)
    extra = np.zeros(len(t))
    begin = 5.0
    while begin < 116.0:
        width, gap = rng.uniform(0.8, 1.6), rng.uniform(1.0, 3.0)
        size = min(0.25 * rig.top * rig.inertia / (width * rig.pace), 0.8 * (rig.limit - hold), 0.8 * rig.limit)
        size *= float(rng.choice([-1.0, 1.0])) * rng.uniform(0.6, 1.0)
        extra[(t >= begin) & (t < begin + width)] = size
        extra[(t >= begin + width + gap) & (t < begin + 2.0 * width + gap)] = -size
        begin += 2.0 * width + gap + rng.uniform(1.0, 3.0)
    return Script(np.where(t < 4.0, SPEED, TORQUE), np.full(len(t), middle), hold + extra)


def starts(rig: Rig, rng: np.random.Generator) -> Script:
    """Make a script from standstill: up, held, coasting to rest or nearly so, a wait."""
    t = _time(rig, 140.0)
    regime, target = np.full(len(t), OFF), np.zeros(len(t))
    begin = 1.0
    while begin < 138.0:
        high = rig.top * rng.uniform(0.5, 0.95)
        rise = high * rig.inertia / ((0.4 + 0.4 * rng.random()) * rig.limit) / rig.pace + 0.5
        hold, coast = rng.uniform(2.0, 6.0), rng.uniform(5.0, 14.0)
        part = (t >= begin) & (t < begin + rise + hold)
        regime[part] = SPEED
        target[part] = high * np.clip((t[part] - begin) / rise, 0.0, 1.0)
        begin += rise + hold + coast
    return Script(regime, target, np.zeros(len(t)))


SCRIPTS = {"multisine": multisine, "ramps": ramps, "pulses": pulses, "starts": starts}


# -- the shaft -----------------------------------------------------------------------------------------------


def turn(rigs: list[Rig], scripts: list[Script], rngs: list[np.random.Generator]) -> tuple[np.ndarray, np.ndarray]:
    """Speed as sensed and torque at the shaft, (steps, columns), each column a rig of its own."""
    many = len(rigs)
    steps = max(len(script.regime) for script in scripts)

    def table(name: str, kind: type) -> np.ndarray:
        found = np.empty((steps, many), dtype=kind)
        for column, script in enumerate(scripts):
            own = getattr(script, name)
            found[: len(own), column], found[len(own) :, column] = own, own[-1]
        return found

    regime, target, feed = table("regime", np.int8), table("target", np.float64), table("feed", np.float64)

    def of(name: str) -> np.ndarray:
        return np.array([getattr(rig, name) for rig in rigs])

    inertia, viscous, square, bell, width = of("inertia"), of("viscous"), of("square"), of("bell"), of("bell_width")
    forward, back = (np.array([rig.coulomb[way] for rig in rigs]) for way in (0, 1))
    step, pace, limit, load_sd, load_time = of("step"), of("pace"), of("limit"), of("load"), of("load_time")
    ripple, sensor = of("ripple"), of("sensor")
    keep = np.exp(-step / load_time)
    drive = load_sd * np.sqrt(1.0 - keep**2)
    quick = 1.0 - np.exp(-step / (0.01 * pace))
    band = 4.0 / pace
    kp, ki = inertia * band, inertia * band**2 / 4.0
    slow_kp = 0.3 / pace * inertia
    slow_ki = slow_kp * 0.08 / pace

    def friction(speed: np.ndarray, way: np.ndarray) -> np.ndarray:
        dry = np.where(way > 0.0, forward, back)
        return way * (dry + bell * np.exp(-((speed / width) ** 2))) + viscous * speed + square * speed * np.abs(speed)

    speeds, torques = np.empty((steps, many)), np.empty((steps, many))
    omega = np.where(regime[0] == OFF, 0.0, target[0])
    motor = np.where(omega != 0.0, friction(omega, np.sign(omega)), 0.0)
    integral, seen = motor.copy(), omega.copy()
    slow = np.zeros(many)
    load = load_sd * np.array([rng.standard_normal() for rng in rngs])
    pulse = np.array([not script.segments for script in scripts])
    for n in range(steps):
        at = n % BLOCK
        if at == 0:
            white = np.stack([rng.standard_normal((BLOCK, 3)) for rng in rngs], axis=2)
        load = keep * load + drive * white[at, 0]
        measured = omega + sensor * white[at, 1]
        seen = seen + quick * (measured - seen)
        error = target[n] - seen
        by_speed, by_torque = regime[n] == SPEED, regime[n] == TORQUE
        command = kp * error + integral
        inside = by_speed & (np.abs(command) < limit)
        integral = np.where(inside, integral + ki * step * error, np.where(by_speed, integral, motor))
        slow = np.where(by_torque & ~pulse, slow + slow_ki * step * error, 0.0)
        open_loop = feed[n] + np.where(pulse, 0.0, slow_kp * error + slow)
        command = np.clip(np.where(by_speed, command, open_loop), -limit, limit)
        off = regime[n] == OFF
        motor = np.where(off, 0.0, motor + quick * (command - motor))
        torque = np.where(off, 0.0, motor + ripple * white[at, 2])
        push = torque + load
        way = np.where(omega != 0.0, np.sign(omega), np.sign(push))
        hold = np.where(push > 0.0, forward, back) + bell
        stuck = (omega == 0.0) & (np.abs(push) <= hold)
        first = (push - friction(omega, way)) / inertia
        second = (push - friction(omega + step * first, way)) / inertia
        after = omega + 0.5 * step * (first + second)
        after = np.where(stuck | ((after * way < 0.0) & (np.abs(push) <= hold)), 0.0, after)
        speeds[n] = 0.5 * (omega + after) + sensor * white[at, 1]
        torques[n] = torque
        omega = after
    return speeds, torques


def reported(signal: np.ndarray, report: Report, step: float) -> np.ndarray:
    """Through the report's filter, by its frequency response; before its first value it stood there for ever."""
    lead = signal[0]
    count = len(signal)
    bridge = round(12.0 * (sum(report.poles) + report.average + report.delay + 0.2) / step)
    whole = 1 << (count + 2 * bridge - 1).bit_length()
    padded = np.zeros(whole)
    padded[:count] = signal - lead
    fade = np.cos(np.linspace(0.0, 0.5 * np.pi, bridge)) ** 2
    padded[count : count + bridge] = fade * (signal[-1] - lead)
    s = 2j * np.pi * np.fft.rfftfreq(whole, step)
    response = np.exp(-report.delay * s)
    for tau in report.poles:
        response = response / (1.0 + tau * s)
    if report.average > 0.0:
        response = response * np.exp(-0.5 * report.average * s) * np.sinc(s.imag * report.average / (2.0 * np.pi))
    return lead + np.fft.irfft(np.fft.rfft(padded) * response, whole)[:count]


def trace(rig: Rig, script: Script, speed: np.ndarray, torque: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(rows, 3): what a tool would have written down."""
    count = len(script.regime)
    grid = np.arange(count) * rig.step
    speed = reported(speed[:count], rig.speed_report, rig.step)
    torque = reported(torque[:count], rig.torque_report, rig.step)
    at = np.arange(0.2 * rig.pace, grid[-1] - 0.2 * rig.pace, 1.0 / rig.rate)
    real = at + rig.jitter / rig.rate * rng.uniform(-0.5, 0.5, len(at))
    seen = np.interp(real - 0.5 * rig.skew, grid, speed) + rig.speed_noise * rng.standard_normal(len(at))
    told = np.interp(real + 0.5 * rig.skew, grid, torque) + rig.torque_noise * rng.standard_normal(len(at))
    return np.column_stack([
        real, np.round(seen / rig.speed_quantum) * rig.speed_quantum,
        np.round(told / rig.torque_quantum) * rig.torque_quantum,
    ])


def written(folder: Path, rig: Rig, motion: str, record: int) -> Path:
    return folder / f"{rig.number:05d}_{motion}_{record:03d}.csv"


def make(folder: Path, wanted: list[tuple[Rig, str, int]]) -> None:
    """Simulate those records that aren't there yet."""
    missing = [one for one in wanted if not written(folder, *one).exists()]
    missing.sort(key=lambda one: (one[1] != "multisine", one[0].number))
    for first in range(0, len(missing), COLUMNS):
        group = missing[first : first + COLUMNS]
        rngs = [np.random.default_rng([rig.number, MOTIONS.index(motion), record, 77]) for rig, motion, record in group]
        scripts = [SCRIPTS[motion](rig, rng) for (rig, motion, _), rng in zip(group, rngs, strict=True)]
        speeds, torques = turn([rig for rig, _, _ in group], scripts, rngs)
        for column, (rig, motion, record) in enumerate(group):
            rows = trace(rig, scripts[column], speeds[:, column], torques[:, column], rngs[column])
            path = written(folder, rig, motion, record)
            if scripts[column].segments:
                path.with_suffix(".yaml").write_text(json.dumps({"kind": "multisine", "mode": "torque",
                                                                 "segments": scripts[column].segments}))
            np.savetxt(path, rows, "%.9g", ",", header="time_s,speed_rad_s,torque_nm", comments="")


# -- the table -----------------------------------------------------------------------------------------------


@dataclass
class Row:
    """One record: J's error and half-width as shares of the truth; NaN without a number."""

    number: int
    cause: str
    motion: str
    record: int
    truth: float
    verdict: str
    reason: str
    error: float
    half: float
    covers: bool
    p_value: float
    took_s: float

    @property
    def told(self) -> bool:
        return math.isfinite(self.error)


def identified(folder: Path, rig: Rig, motion: str, record: int) -> Row:
    path = written(folder, rig, motion, record)
    declared = path.with_suffix(".yaml")
    begun_s = time.perf_counter()
    one = tdhil.identify(tdhil.read(path, excitation=declared if declared.exists() else None)).to_dict()
    took_s = time.perf_counter() - begun_s
    inertia, truth = one["inertia_kg_m2"], rig.inertia
    residual = one.get("residual") or {}
    p_value = residual.get("p_value", math.nan)
    if inertia is None:
        return Row(rig.number, rig.cause, motion, record, truth, one["verdict"], one["reason"], math.nan, math.nan,
                   False, p_value, took_s)
    low, high = inertia["low"], inertia["high"]
    return Row(rig.number, rig.cause, motion, record, truth, one["verdict"], one["reason"],
               inertia["value"] / truth - 1.0, 0.5 * (high - low) / truth, low <= truth <= high, p_value, took_s)


def lower_bound(misses: int, runs: int) -> float:
    """One-sided 99 % bound of a rate (Clopper and Pearson)."""
    from scipy.stats import beta

    return float(beta.ppf(0.01, misses, runs - misses + 1)) if misses else 0.0


def line(name: str, rows: list[Row], goal: str = "") -> str:
    told = [row for row in rows if row.told]
    if not told:
        return f"{name:<24}{0:>5}/{len(rows):<5}"
    error = 100.0 * np.abs([row.error for row in told])
    half = 100.0 * np.array([row.half for row in told])
    misses = sum(not row.covers for row in told)
    rmse = float(np.sqrt(np.mean(error**2)))
    refused = 100.0 * (1.0 - len(told) / len(rows))
    return (f"{name:<24}{len(told):>5}/{len(rows):<5}{np.median(error):>7.2f}{np.quantile(error, 0.9):>7.2f}"
            f"{refused:>8.1f}{np.median(half):>8.2f}{100.0 * (1.0 - misses / len(told)):>8.1f}"
            f"{100.0 * lower_bound(misses, len(told)):>7.1f}{np.median(half) / np.median(error):>8.1f}"
            f"{np.mean(half) / rmse:>8.1f}{np.mean([row.took_s for row in rows]):>7.2f}  {goal}")


HEADER = (f"{'':<24}{'told':>11}{'median':>7}{'p90':>7}{'refused':>8}{'half':>8}{'covers':>8}{'miss≥':>7}"
          f"{'half/med':>8}{'/rmse':>8}{'s':>7}  goal (median / p90 / refused / half), all in %")


def told(rows: list[Row]) -> bool:
    """Print the tables; is coverage beyond doubt nowhere below 95 %, for each cause, motion and both?"""
    print(HEADER)
    for motion in MOTIONS:
        mine = [row for row in rows if row.motion == motion]
        if mine:
            print(line(motion, mine, " / ".join(f"{x:g}" for x in GOALS[motion])))
    groups = [[row for row in rows if row.cause == cause] for cause in CAUSES]
    groups = [group for group in groups if group]
    for group in groups:
        print(line(group[0].cause, group))
        for motion in MOTIONS:
            mine = [row for row in group if row.motion == motion]
            if mine:
                print(line(f"    {motion}", mine))
    print("refused:")
    for (cause, motion, verdict, reason), count in Counter(
        (row.cause, row.motion, row.verdict, row.reason[:90]) for row in rows if not row.told
    ).most_common(40):
        print(f"  {count:>4} × {cause}, {motion}: {verdict}: {reason}")
    print("missed:")
    for row in rows:
        if row.told and not row.covers:
            print(f"  rig {row.number} {row.cause}, {row.motion} {row.record}: {100 * row.error:+.2f} ± "
                  f"{100 * row.half:.2f} %")
    both = {(cause, motion): [row for row in rows if cause in ("all", row.cause) and motion in ("all", row.motion)]
            for cause in ("all", *CAUSES) for motion in ("all", *MOTIONS)}
    failed = []
    for (cause, motion), group in both.items():
        numbers = [row for row in group if row.told]
        misses = sum(not row.covers for row in numbers)
        if lower_bound(misses, len(numbers)) > MOST_MISSED:
            failed.append(f"{cause}, {motion}: {misses} of {len(numbers)} miss")
    print(f"coverage below {1.0 - MOST_MISSED:.0%} beyond chance: {'; '.join(failed) or 'nowhere'}")
    return not failed


def main() -> int:
    """0 if no miss rate of a cause, a motion or both is above 5 % beyond doubt."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rigs", type=int, default=300)
    parser.add_argument("--records", type=int, default=1, help="of each motion")
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--cause", choices=CAUSES, help="only rigs with this")
    parser.add_argument("--mixed", action="store_true", help="rigs with a second cause, drawn at random")
    parser.add_argument("--motion", choices=MOTIONS, help="only this motion")
    parser.add_argument("--keep", type=Path, help="a folder for the traces, read again if they are there")
    parser.add_argument("--out", type=Path, help="every record as a line of JSON")
    asked = parser.parse_args()
    rigs = [draw(number, asked.mixed) for number in range(asked.first, asked.first + asked.rigs)]
    wanted = [(rig, motion, record) for rig in rigs for motion in MOTIONS for record in range(asked.records)
              if asked.cause in (None, rig.cause) and asked.motion in (None, motion)]
    rows: list[Row] = []
    out = asked.out.open("w", encoding="utf-8") if asked.out else None
    with TemporaryDirectory() as temporary:
        folder = asked.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for first in range(0, len(wanted), 8 * COLUMNS):
            part = wanted[first : first + 8 * COLUMNS]
            begun_s = time.perf_counter()
            make(folder, part)
            print(f"simulated {len(part)} records in {time.perf_counter() - begun_s:.0f} s", file=sys.stderr)
            for one in part:
                rows.append(identified(folder, *one))
                if out is not None:
                    print(json.dumps(rows[-1].__dict__), file=out, flush=True)
    if out is not None:
        out.close()
    return 0 if told(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
