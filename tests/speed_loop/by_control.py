"""Margins and step response of a speed loop by python-control, which shares no code with `tdhil.speed_loop`."""

from __future__ import annotations

import math

import control
import numpy as np

from tdhil.speed_loop import LoopPlant, PiGains, SpeedLoopMargins

PADE, STEP_PADE = 6, 2
"""Order of the dead time's approximation for margins, and for steps, where a high order is ill-conditioned."""


def shaft(plant: LoopPlant, at_load: float = 0.0):
    """Return ω/T by the equations of motion. ``at_load``: viscous friction of the load."""
    inertia, viscous, spring = plant.inertia_kg_m2, plant.viscous_nm_s_rad, plant.spring
    if spring is None:
        return control.tf([1.0], [inertia, viscous])
    c, k, load = spring.damping_nm_s_rad, plant.stiffness_nm_rad, plant.load_kg_m2
    a = [[-(c + viscous) / inertia, c / inertia, -k / inertia], [c / load, -(c + at_load) / load, k / load],
         [1.0, -1.0, 0.0]]
    return control.tf(control.ss(a, [[1.0 / inertia], [0.0], [0.0]], [[1.0, 0.0, 0.0]], 0.0))


def forward(plant: LoopPlant, gains: PiGains, at_load: float = 0.0, order: int = PADE):
    """Return the response from the speed error to the motor's speed."""
    s = control.tf("s")
    found = (gains.gain_nm_s_rad + gains.integral_nm_rad / s) * shaft(plant, at_load)
    if gains.notch is not None:
        omega = 2.0 * math.pi * gains.notch.hertz
        found *= ((s**2 + 2.0 * gains.notch.numerator_damping * omega * s + omega**2)
                  / (s**2 + 2.0 * gains.notch.denominator_damping * omega * s + omega**2))
    for lag in plant.lags_s[1:]:
        found *= 1.0 / (1.0 + lag * s)
    if plant.dead_time_s > 0.0:
        found *= control.tf(*control.pade(plant.dead_time_s, order))
    return found


def filter_of(plant: LoopPlant):
    """Return the filter of the measured speed."""
    return control.tf([1.0], [plant.lags_s[0], 1.0]) if plant.lags_s else control.tf([1.0], [1.0])


def true_margins(plant: LoopPlant, gains: PiGains, at_load: float = 0.0) -> SpeedLoopMargins:
    """Return the least phase and gain margin over all crossovers; the bandwidth is not judged."""
    loop = forward(plant, gains, at_load) * filter_of(plant)
    stable = bool(np.all(np.real(control.poles(control.feedback(loop, 1))) < 0.0))
    size, phase, modulus, *_ = control.stability_margins(loop, returnall=True)
    distances = [abs((degrees + 180.0) % 360.0 - 180.0) for degrees in phase]
    decibels = [abs(20.0 * math.log10(one)) for one in size if one > 0.0]
    return SpeedLoopMargins(stable, min(distances, default=math.inf), min(decibels, default=math.inf), math.nan,
                            1.0 / min(modulus, default=math.inf), False)


def step(plant: LoopPlant, gains: PiGains, time_s: np.ndarray) -> np.ndarray:
    """Return the motor's speed after a unit step of the set speed."""
    closed = control.feedback(forward(plant, gains, order=STEP_PADE), filter_of(plant))
    return np.asarray(control.forced_response(control.ss(closed), time_s, np.ones_like(time_s)).outputs)
