"""The drive's speed loop as a linear one: what amplitudes theory expects, to set beside those from the bus.

::

    reference ──►(+)──► K_p + K_i/s ──► 1/(1 + t s) ──► 1/(J s + B) ──┬──► speed ──► 1/(1 + τ_w s) ──► reported
                  ▲(−)                                                │
                  └────────────── 1/(1 + τ_f s) ◄─────────────────────┘

    speed/reference = C P / (1 + C P F),    C = (K_p + K_i/s)/(1 + t s),  P = 1/(J s + B),  F = 1/(1 + τ_f s)

Coulomb friction is constant while the shaft turns one way, and drops out. K_p in N·m·s/rad, K_i in N·m/rad. Written
here and not taken from the simulator: two derivations that agree are worth more than one.
"""

from __future__ import annotations

import numpy as np

from tdhil.recording.recording import FloatArray
from tdhil.studies.field.settings import SimulatedRig


def gain(
    rig: SimulatedRig, hertz: FloatArray | float, kp: FloatArray | float, ki: FloatArray | float, *, reported: bool
) -> FloatArray:
    """Output amplitude over input amplitude, broadcast over the arguments; of the shaft, or of what is reported."""
    s = 2j * np.pi * np.asarray(hertz, dtype=np.float64)
    control = (np.asarray(kp) + np.asarray(ki) / s) / (1.0 + rig.loop_torque_lag_s * s)
    forward = control / (rig.inertia_kg_m2 * s + rig.viscous_nm_s_rad)
    closed = forward / (1.0 + forward / (1.0 + rig.loop_filter_s * s))
    if reported:
        closed = closed / (1.0 + rig.speed_lag_s * s)
    size: FloatArray = np.abs(np.asarray(closed, dtype=np.complex128))
    return size


def tones_with_steady_rise(rig: SimulatedRig, kp: float, ki_values: tuple[float, ...]) -> tuple[int, int]:
    """At how many of how many tones from 0.05 to 1 Hz |gain − 1| rises throughout ``ki_values`` (figure 21)."""
    tones = np.linspace(0.05, 1.0, 96)
    grid = np.linspace(min(ki_values), max(ki_values), 60)
    away = np.abs(gain(rig, tones[:, None], kp, grid[None, :], reported=True) - 1.0)
    return int(np.sum(np.all(np.diff(away, axis=1) > 0.0, axis=1))), len(tones)


def best_kp(rig: SimulatedRig, hertz: float, ki: float, low: float, high: float) -> float:
    """The P between ``low`` and ``high`` at which |gain − 1| of the reported speed is least; an edge if it is there."""
    grid = np.geomspace(low, high, 400)
    return float(grid[int(np.argmin(np.abs(gain(rig, hertz, grid, ki, reported=True) - 1.0)))])
