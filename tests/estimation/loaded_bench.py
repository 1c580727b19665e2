"""Independent drill string: waves in delay lines between motor and bit, many seeds at once.

Wave down a = τ + ζω, up b = ζω − τ (τ: torque down), constant within a section. Between two sections,
mud drags with d: ω = (a + b)/(ζ₁ + ζ₂ + d), up 2ζ₁ω − a, down 2ζ₂ω − b. Motor: J dω/dt = T − T_c − (B + ζ) ω
+ b. Bit: J_b dΩ/dt = a − ζΩ − T_bit − noise.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from tdhil.estimation import torque_answer
from tdhil.recording import Excitation, LagPrior, Pipe, Segment
from tests.estimation.reporting import recorded

STEP_S = 0.02
SECTION_STEPS = 4


@dataclass(frozen=True)
class Loaded:
    """2300 m of pipe above a bit. ``bit_nm``: torque of the bit in motion. ``bit_noise_nm``: its scatter."""

    motor: float = 1500.0
    viscous: float = 8.0
    resistance: float = 296.5
    sections: int = 9                 # of 0.08 s each
    drag: float = 11.5                # of all of the mud
    collars: float = 1.0              # ratio of the lowest section's impedance to the pipe's
    bottom: float = 374.0
    bit_nm: float = 2500.0
    bit_viscous: float = 20.0
    bit_noise_nm: float = 0.0
    bit_correlation_s: float = 0.3
    speed_lags_s: tuple[float, ...] = (0.40,)
    torque_lags_s: tuple[float, ...] = (0.15,)
    hold: float = 750.0               # gain of the host's slow control of the mean speed, N·m·s/rad
    mean_rad_s: float = 20.0
    own_lag_s: float = 0.01           # lag of the torque behind its setpoint
    answered: bool = True             # is the response of the torque to its setpoint used?
    speed_noise_rad_s: float = 0.003
    torque_noise_nm: float = 5.0

    def pipe(self, wrong: float = 0.0) -> Pipe:
        """Return the pipe as in rig.yaml, with a relative error of ζ."""
        straight = self.sections - (self.collars != 1.0)
        delay_s, zeta = straight * SECTION_STEPS * STEP_S, self.resistance * (1.0 + wrong)
        return Pipe(zeta * delay_s, zeta / delay_s, 0.03, "rig.yaml")


def turned(plant: Loaded, drive, noise):
    """Return motor speed and torque, (steps, runs); ``drive`` (steps,) and ``noise`` (steps, runs), N·m."""
    steps, count = noise.shape
    mean, many = plant.mean_rad_s, plant.sections
    zeta = np.full(many, plant.resistance)
    zeta[-1] *= plant.collars
    drag = plant.drag / (many - 1)
    load = plant.bit_nm + plant.bit_viscous * mean
    # mean torque of each section
    carried = load + drag * mean * np.arange(many - 1, -1, -1.0)
    down = np.tile((carried + zeta * mean)[:, None, None], (1, SECTION_STEPS, count))
    up = np.tile((zeta * mean - carried)[:, None, None], (1, SECTION_STEPS, count))
    speed, bottom, seen = (np.full(count, mean) for _ in range(3))
    hold_nm = carried[0] + plant.viscous * mean
    loss, loss_b = plant.viscous + zeta[0], plant.bit_viscous + zeta[-1]
    share, gone = _over_a_step(plant.motor / loss)
    share_b, gone_b = _over_a_step(plant.bottom / loss_b)
    late = np.exp(-STEP_S / max(sum(plant.speed_lags_s), 1e-3))
    meet = (zeta[:-1] + zeta[1:] + drag)[:, None]
    speeds, torques = np.empty((steps, count)), np.empty((steps, count))
    for at in range(steps):
        slot = at % SECTION_STEPS
        arrived_down, arrived_up = down[:, slot].copy(), up[:, slot].copy()
        torque = hold_nm + drive[at] + plant.hold * (mean - seen)
        speeds[at], torques[at] = speed, torque
        joint = (arrived_down[:-1] + arrived_up[1:]) / meet
        up[:-1, slot] = 2.0 * zeta[:-1, None] * joint - arrived_down[:-1]
        down[1:, slot] = 2.0 * zeta[1:, None] * joint - arrived_up[1:]
        steady = (torque + arrived_up[0]) / loss
        down[0, slot] = 2.0 * zeta[0] * (steady + (speed - steady) * gone) - arrived_up[0]
        speed = steady + (speed - steady) * share
        steady = (arrived_down[-1] - plant.bit_nm - noise[at]) / loss_b
        up[-1, slot] = 2.0 * zeta[-1] * (steady + (bottom - steady) * gone_b) - arrived_down[-1]
        bottom = steady + (bottom - steady) * share_b
        seen = speed + (seen - speed) * late
    return speeds, torques


def _over_a_step(tau_s):
    """Return the remaining share of a deviation at the end of a step, and its mean over the step."""
    share = np.exp(-STEP_S / tau_s)
    return share, (1.0 - share) * tau_s / STEP_S


def records(plant: Loaded, seeds, lines_hz, torques, period_s, periods, settle=2, lag_prior=None):
    """Return one recording per seed with a pipe error of 3 % (1 sd); ``torques``: complex excitation, (K,)."""
    streams = [np.random.default_rng([7, seed]) for seed in seeds]
    time = STEP_S * np.arange(round((settle + periods) * period_s / STEP_S))
    drive = (np.exp(2j * np.pi * np.outer(time, lines_hz)) @ torques).real
    keep = np.exp(-STEP_S / plant.bit_correlation_s)
    white = np.stack([stream.standard_normal(len(time)) for stream in streams], axis=1)
    noise = plant.bit_noise_nm * lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], white, axis=0)
    speeds, acted = turned(plant, drive, noise)
    commanded = acted + plant.own_lag_s / STEP_S * np.diff(acted, axis=0, append=acted[-1:])
    for lag_s in plant.speed_lags_s:
        speeds = late(speeds, lag_s)
    for lag_s in plant.torque_lags_s:
        acted = late(acted, lag_s)
    segment = Segment(0.0, (settle + periods) * period_s, period_s, settle, plant.mean_rad_s, tuple(lines_hz), (), ())
    found = [
        recorded(
            time, speeds[:, run] + plant.speed_noise_rad_s * stream.standard_normal(len(time)),
            acted[:, run] + plant.torque_noise_nm * stream.standard_normal(len(time)),
            excitation=Excitation("prbs", "torque", (segment,)), torque_limit_nm=15000.0, simulated=True,
            lag_prior=lag_prior or LagPrior(), pipe=plant.pipe(0.03 * float(stream.standard_normal())),
        )
        for run, stream in enumerate(streams)
    ]
    if not plant.answered:
        return found
    return [replace(one, torque_answer=torque_answer(one, commanded[:, run])) for run, one in enumerate(found)]


def late(signal, lag_s):
    """Apply a first-order lag to a signal that is linear between samples."""
    keep = np.exp(-STEP_S / lag_s)
    ramp = 1.0 - (1.0 - keep) * lag_s / STEP_S
    first = (1.0 - keep) - ramp
    return lfilter([ramp, first], [1.0, -keep], signal, axis=0, zi=signal[:1] * (1.0 - ramp))[0]
