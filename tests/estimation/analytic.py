"""Recordings in closed form: exact lines of an exact transfer function, plus a small seeded disturbance."""

import numpy as np

from tdhil.recording.recording import Excitation, LagPrior, Segment
from tests.estimation.reporting import recorded

LINES = (0.1, 0.2, 0.3, 0.4)


def closed_form(
    inertia=104.0,
    viscous=8.0,
    coulomb=60.0,
    speed_lag=0.40,
    torque_lag=0.15,
    skew=0.0,
    offsets=(4.0, 7.0),
    lines=LINES,
    amplitudes=(1.5, 0.8, 0.25, 0.25),
    periods=7,
    noise=0.3,
    start=0.0,
    rate_hz=50.0,
    lag_prior=None,
    seed=5,
    unrecorded_s=0.0,
    phases_rad=None,
):
    """Return a recording. ``phases_rad``: phases of the lines, one row per segment; None: the same in all segments.

    ``noise``: sd of white noise of the reported torque per sample, N·m. ``unrecorded_s``: pause between segments.

    The closed form has no torque for changes of the mean speed. Without a pause, its momentum balance is false.
    """
    rng = np.random.default_rng(seed)
    omega = 2.0 * np.pi * np.array(lines)
    s = 1j * omega
    phases = np.array([0.3, 1.7, 4.0, 5.1, 2.4, 0.9, 5.6, 3.1, 1.2, 4.6])
    through = (inertia * s + viscous) * (1 + speed_lag * s) / (1 + torque_lag * s) * np.exp(-skew * s)
    times, speeds, torques, segments = [], [], [], []
    begin = 0.0
    period = 10.0
    for number, offset in enumerate(offsets):
        own = phases[: len(lines)] if phases_rad is None else np.asarray(phases_rad[number])
        speed_lines = np.array(amplitudes) * np.exp(1j * own)
        t = np.arange(round(periods * period * rate_hz)) / rate_hz
        turned = np.exp(1j * np.outer(t, omega))
        times.append(start + begin + t)
        speeds.append(offset + (turned @ speed_lines).real)
        torques.append(coulomb + viscous * offset + (turned @ (through * speed_lines)).real)
        segments.append(
            Segment(start + begin, start + begin + periods * period, period, 1, offset, tuple(lines),
                    tuple(amplitudes), tuple(np.angle(speed_lines)))
        )
        begin += periods * period + unrecorded_s
    time = np.concatenate(times)
    return recorded(
        time, np.concatenate(speeds), np.concatenate(torques) + noise * rng.standard_normal(len(time)),
        excitation=Excitation("multisine" if len(lines) > 1 else "sine", "torque", tuple(segments)),
        lag_prior=lag_prior or LagPrior(),
        torque_limit_nm=1000.0,
    )
