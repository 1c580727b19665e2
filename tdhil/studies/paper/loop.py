r"""The paper's closed loop (figure 8), all runs at once.

::

    e = w_r − ω                         T_in = Kp e + Ki ∫e dt          (equations 9 and 10 of section 3.2.2)
    J dω/dt = T_in + d − T_f − B ω      dz/dt = ω (1 − (σ z/F_c) sgn ω), T_f = σ z          (equations 4 and 6)

d is band-limited white torque, held over a sample: a disturbance of the shaft that T_in doesn't contain. Everything
starts at rest: speed, bristle and integral are zero, so that T_in begins with Kp·w_r(0).

The controller is continuous. Over a step h the plant takes one torque, so the step is done twice (Heun's method): with
the torque of the beginning, which predicts e, and again with the mean of that torque and the predicted one; the
integral is trapezoidal. Both errors are of order h²: at Kp h/J = 0.017 (15000 N·m·s/rad, 1 ms, 900 kg·m²) about 1e-4 of
the fastest transient, and at most 0.04 kg·m² in the J of any run of Tables 6 and 7 (a test halves h).

A sample holds T_in and ω of one instant. The paper's α between two samples (equation 16) is paired with the torque at
the end of the interval, see `processing`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_bus.plant.batch import SPEED, FixedStep, Shafts, white_torque
from tdhil.study.loop_reference import Reference, reference_of
from tdhil.study.settings import LoopSettings

FloatArray = NDArray[np.float64]

_PROGRESS_STEPS = 500


@dataclass(frozen=True)
class LoopRecord:
    """What was logged: one row per sample (the first at t = 0), one column per run."""

    time_s: FloatArray
    reference_rad_s: FloatArray
    speed_rad_s: FloatArray
    torque_nm: FloatArray

    @property
    def simulated_s(self) -> float:
        """Plant time, all runs added up."""
        return float(self.time_s[-1].sum())

    def of(self, run: int, samples: slice = slice(None)) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(time, reference, speed, torque) of one run."""
        return (
            self.time_s[samples, run], self.reference_rad_s[samples, run], self.speed_rad_s[samples, run],
            self.torque_nm[samples, run],
        )


def simulate(
    runs: Sequence[LoopSettings],
    progress: Callable[[float], None] = lambda share: None,
    references: Sequence[Reference] | None = None,
) -> LoopRecord:
    """Simulates ``runs`` side by side; they need the same number of samples, not the same duration.

    The noise comes from the first run's seed.
    """
    steps = runs[0].steps
    if any(run.steps != steps for run in runs):
        raise ValueError("runs of one batch must have the same number of samples")
    shafts = Shafts.of(
        [run.inertia_kg_m2 for run in runs], [run.viscous_nm_s_rad for run in runs], [run.coulomb_nm for run in runs],
        [run.dahl_stiffness_nm_rad for run in runs], [run.friction == "dahl" for run in runs],
    )
    kp, ki, period, power = (
        np.array([getattr(run, name) for run in runs])
        for name in ("kp_nm_s_rad", "ki_nm_rad", "sample_period_s", "noise_power_nm2_s")
    )
    time = np.arange(steps + 1)[:, np.newaxis] * period
    asked = np.empty_like(time)
    for column, reference in enumerate(references or [reference_of(run) for run in runs]):
        asked[:, column] = reference.at(time[:, column])
    speed, torque = np.zeros_like(time), np.zeros_like(time)
    disturbance = white_torque(power, period, steps, np.random.default_rng(runs[0].seed))
    plant, state, half = FixedStep(shafts, period), shafts.at_rest(), 0.5 * period
    integral = np.zeros(len(runs))
    error = asked[0] - state[SPEED]
    torque[0] = kp * error
    for now in range(steps):
        drive = torque[now]
        guess = asked[now + 1] - plant.advance(state, drive + disturbance[now])[SPEED]
        ahead = kp * guess + ki * (integral + half * (error + guess))
        state = plant.advance(state, 0.5 * (drive + ahead) + disturbance[now])
        later = asked[now + 1] - state[SPEED]
        integral = integral + half * (error + later)
        error = later
        speed[now + 1] = state[SPEED]
        torque[now + 1] = kp * error + ki * integral
        if now % _PROGRESS_STEPS == 0:
            progress(now / steps)
    return LoopRecord(time, asked, speed, torque)
