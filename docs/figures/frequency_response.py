"""Draws the pictures of the page on the frequency response: ``python docs/figures/frequency_response.py [NAME ...]``.

Each picture is a simulated machine with one fault, identified by tdhil and drawn by the code of the report. The machine
is a motor with a load on a spring or without one, at 2 ms, in this file alone.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from chosen_names import chosen  # noqa: E402

from tdhil.estimation import identify  # noqa: E402
from tdhil.recording import Excitation, LagPrior, Recording, Segment  # noqa: E402
from tdhil.report import draw_faults, inline_svg, response_sentences, result_document  # noqa: E402

IMAGES = ROOT / "docs" / "images"
STEP_S, SAMPLE_EVERY, PERIOD_S, PERIODS, SETTLE = 0.002, 5, 10.0, 8, 1


@dataclass(frozen=True)
class Machine:
    """A machine with a fault. SI units; a ``load`` of 0 kg·m² is a rigid shaft, a ``gap`` in rad is backlash."""

    speeds: tuple[float, ...] = (4.0, 7.0)
    lines: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
    amplitudes: tuple[float, ...] = (1.2, 0.7, 0.3, 0.25, 0.2, 0.15)
    motor: float = 104.0
    load: float = 0.0
    spring: float = 0.0
    damping: float = 0.0
    gap: float = 0.0
    load_friction: float = 0.0
    viscous: float = 8.0
    coulomb: float = 60.0
    stribeck: float = 0.0
    stribeck_width: float = 2.5
    true_limit: float = math.inf  # torque that the motor has; the drive reports its demand
    reported_limit: float = math.inf  # torque that the motor has; the drive reports it and its limit
    warming: tuple[float, float] = (0.0, 30.0)  # N·m more friction at the start, and its time constant in s
    lost: tuple[float, float] = (0.0, math.inf)  # kg·m² that come off the shaft, and when in s
    speed_noise: float = 0.01
    speed_step: float = 0.01
    lags_s: tuple[float, float] = (0.40, 0.15)  # of the reported speed and torque
    lag_prior: LagPrior = field(default_factory=LagPrior)
    settle: int = SETTLE


CASES = {
    "frf_good": Machine(),
    "frf_stribeck": Machine(speeds=(2.6, 7.0), stribeck=40.0),
    "frf_zero": Machine(speeds=(1.2, 5.0)),
    "frf_backlash": Machine(
        motor=54.0, load=50.0, spring=8000.0, damping=120.0, gap=0.06, load_friction=12.0, coulomb=48.0
    ),
    "frf_resonance": Machine(
        load=60.0,
        spring=340.0,
        damping=12.0,
        lines=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        amplitudes=(1.0, 0.6, 0.35, 0.2, 0.15, 0.12, 0.12, 0.12),
        settle=2,
    ),
    "frf_quantised": Machine(speed_step=0.35),
    "frf_saturation": Machine(true_limit=230.0),
    "frf_lag": Machine(lag_prior=LagPrior(0.20, 0.005, 0.15, 0.005, "rig.yaml")),
}
"""Name of the picture and its machine."""


def simulated(machine: Machine, seed: int = 7) -> Recording:
    """Turn the machine under its torque and a slow control of its mean speed; return the reports."""
    rng = np.random.default_rng(seed)
    m, length = machine, PERIODS * PERIOD_S
    phases = np.array([5.38, 1.34, 0.44, 5.82, 2.9, 4.4, 0.9, 3.6])[: len(m.lines)]
    omega = 2.0 * math.pi * np.array(m.lines)
    turned = np.exp(1j * (np.outer(np.arange(round(length / STEP_S)) * STEP_S, omega) + phases))
    deviation = (turned @ np.array(m.amplitudes)).real
    inertia = m.motor + m.load
    feed = (turned @ (np.array(m.amplitudes) * (1j * omega * inertia + m.viscous))).real
    ramp = round(8.0 / STEP_S)
    target, forward, starts = [], [], []
    for number, mean in enumerate(m.speeds):
        if number:
            target.append(np.linspace(m.speeds[number - 1], mean, ramp))
            forward.append(np.full(ramp, inertia * (mean - m.speeds[number - 1]) / 8.0 + m.viscous * mean))
        starts.append(sum(map(len, target)) * STEP_S)
        target.append(mean + deviation)
        forward.append(feed + m.viscous * mean)
    wanted, torque_ff = np.concatenate(target), np.concatenate(forward) + m.coulomb + m.load_friction
    steps = len(wanted)
    noise, sensed = 8.0 * rng.standard_normal(steps), m.speed_noise * rng.standard_normal(steps)
    speed_of_motor = speed_of_load = float(wanted[0])
    twist = (0.5 * m.gap + m.load_friction / m.spring) if m.load else 0.0
    integral = seen = seen_target = 0.0
    speeds, torques = np.empty(steps), np.empty(steps)
    for n in range(steps):
        seen += STEP_S / 0.4 * (speed_of_motor - wanted[0] - seen)
        seen_target += STEP_S / 0.4 * (wanted[n] - wanted[0] - seen_target)
        error = seen_target - seen
        integral += 2.5 * STEP_S * error
        demand = torque_ff[n] + 25.0 * error + integral
        demand = max(-m.reported_limit, min(m.reported_limit, demand))
        speeds[n], torques[n] = speed_of_motor + sensed[n], demand
        torque = max(-m.true_limit, min(m.true_limit, demand)) + noise[n]
        friction = m.viscous * speed_of_motor + math.copysign(
            m.coulomb + m.warming[0] * math.exp(-n * STEP_S / m.warming[1])
            + m.stribeck * math.exp(-((speed_of_motor / m.stribeck_width) ** 2)), speed_of_motor
        )
        through = 0.0
        if m.load:
            beyond = twist - max(-0.5 * m.gap, min(0.5 * m.gap, twist))
            through = m.spring * beyond + (m.damping * (speed_of_motor - speed_of_load) if beyond else 0.0)
            twist += STEP_S * (speed_of_motor - speed_of_load)
            speed_of_load += STEP_S / m.load * (through - math.copysign(m.load_friction, speed_of_load))
        motor = m.motor - (m.lost[0] if n * STEP_S > m.lost[1] else 0.0)
        speed_of_motor += STEP_S / motor * (torque - friction - through)
    reports = [_lagged(signal, lag)[::SAMPLE_EVERY] for signal, lag in zip((speeds, torques), m.lags_s, strict=True)]
    count = len(reports[0])
    return Recording(
        time_s=np.arange(count) * STEP_S * SAMPLE_EVERY,
        speed_rad_s=np.round(reports[0] / m.speed_step) * m.speed_step,
        torque_nm=np.round(reports[1] + 2.0 * rng.standard_normal(count)),
        fresh=np.ones(count, dtype=bool),
        limited=np.abs(torques[::SAMPLE_EVERY]) >= m.reported_limit,
        excitation=Excitation("multisine", "torque", tuple(
            Segment(start, start + length, PERIOD_S, m.settle, mean, m.lines, m.amplitudes, tuple(phases.tolist()))
            for start, mean in zip(starts, m.speeds, strict=True)
        )),
        lag_prior=m.lag_prior,
        speed_resolution_rad_s=m.speed_step,
        torque_resolution_nm=1.0,
        torque_limit_nm=min(2000.0, m.reported_limit),
        simulated=True,
    )


def _lagged(signal: np.ndarray[Any, Any], lag_s: float) -> np.ndarray[Any, Any]:
    from scipy.signal import lfilter

    keep = math.exp(-STEP_S / lag_s)
    found, _ = lfilter([1.0 - keep], [1.0, -keep], signal, zi=[keep * signal[0]])
    return np.asarray(found)


def document(name: str) -> dict[str, Any]:
    """Return the result document of a case."""
    recording = simulated(CASES[name])
    return result_document(identify(recording), recording, {}, "run.mcap")


def picture(found: dict[str, Any]) -> str:
    """Return the SVG of a response; curves have four digits."""
    return inline_svg(partial(draw_faults, found=found["frequency_response"]), (7.0, 3.6)) + "\n"


def main(names: Sequence[str]) -> int:
    """Draw the named pictures, or all, and print what the response of each shows."""
    for name in names or CASES:
        found = document(name)
        (IMAGES / f"{name}.svg").write_text(picture(found), encoding="utf-8")
        said = " ".join(response_sentences(found["frequency_response"]))
        print(f"docs/images/{name}.svg: {json.dumps(found['verdict'])} {found['model']}: {said}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(chosen(__doc__, CASES, sys.argv[1:])))
