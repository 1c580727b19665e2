"""Reference case, and a drill string as a chain of lumped masses: an oracle that is independent of the product.

The chain consists of masses and springs. Its equations form a matrix, and the eigenvalues give its modes. It uses no
wave, no transmission line and no delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from tdhil.soft_torque import BottomEnd, PipeSection, SpeedController, StringFile, TopDrive, string_of

FIVE_INCH = {"outer_diameter_m": 0.127, "inner_diameter_m": 0.1086}
BIT = {"friction": "stribeck", "static_nm": 5000.0, "coulomb_nm": 2500.0, "stribeck_speed_rad_s": 2.5,
       "viscous_nm_s_rad": 20.0}


def string_with(*, length_m: float = 3000.0, drag: float = 0.005, **bottom):
    section = PipeSection(length_m=length_m, drag_nm_s_rad_m=drag, **FIVE_INCH)
    return string_of(StringFile(sections=(section,), bottom=BottomEnd(**{"inertia_kg_m2": 374.0, **BIT, **bottom})))


STRING = string_with()
DRIVE = TopDrive(1500.0, 8.0, 60.0, (0.020, 0.010, 0.003))

# The settings of the reference table: P, I, J_c.
STIFF = SpeedController(20286.0, 26454.0)
PAPER = SpeedController(4327.0, 4327.0)
SOFT_1 = SpeedController(296.5, 999.3)
SOFT_025 = SpeedController(1186.0, 999.3)
SOFT_035 = SpeedController(847.1, 705.1)
HALF = SpeedController(847.1, 352.6, 750.0)
TABLE = {"stiff": STIFF, "paper": PAPER, "a=1": SOFT_1, "a=0.25": SOFT_025, "a=0.35": SOFT_035, "half": HALF}


@dataclass(frozen=True)
class Pipe:
    """One section of the chain. The material constants are stated here again, independent of the product."""

    length_m: float
    outer_m: float
    inner_m: float
    shear_pa: float = 79.3e9
    density: float = 7850.0
    drag: float = 0.005
    lumps: int = 50


def lumped_chain(pipes, bottom_inertia, bottom_viscous, drive=None, controller=None, *, stuck=False):
    """Return (A, b, number of masses) of x' = A x + b Ω, with angles, speeds and the controller's states in x.

    Without a drive, the top is held. Half of a cell's mass is at each of its ends, with a spring between them.
    """
    masses, losses, springs = [0.0], [0.0], []
    for pipe in pipes:
        polar = pi * (pipe.outer_m**4 - pipe.inner_m**4) / 32.0
        cell = pipe.length_m / pipe.lumps
        for _ in range(pipe.lumps):
            masses[-1] += 0.5 * pipe.density * polar * cell
            losses[-1] += 0.5 * pipe.drag * cell
            masses.append(0.5 * pipe.density * polar * cell)
            losses.append(0.5 * pipe.drag * cell)
            springs.append(pipe.shear_pa * polar / cell)
    masses[-1] += bottom_inertia
    losses[-1] += bottom_viscous
    if drive is not None:
        masses[0] += drive.inertia_kg_m2
        losses[0] += drive.viscous_nm_s_rad
    count = len(masses)
    free = list(range(0 if drive is not None else 1, count - 1 if stuck else count))
    stiffness = np.zeros((count, count))
    for k, spring in enumerate(springs):
        stiffness[k : k + 2, k : k + 2] += spring * np.array([[1.0, -1.0], [-1.0, 1.0]])
    stiffness = stiffness[np.ix_(free, free)]
    mass, loss = np.array(masses)[free], np.array(losses)[free]
    n = len(free)
    lags = list(drive.inner_lags_s) if drive is not None else []
    size = 2 * n + (2 + len(lags) if drive is not None else 0)
    a, b = np.zeros((size, size)), np.zeros(size)
    a[:n, n : 2 * n] = np.eye(n)
    a[n : 2 * n, :n] = -stiffness / mass[:, None]
    a[n : 2 * n, n : 2 * n] = -np.diag(loss / mass)
    if drive is not None:
        speed, integral, derivative, first = n, 2 * n, 2 * n + 1, 2 * n + 2
        a[integral, speed], b[integral] = -controller.integral_nm_rad, controller.integral_nm_rad
        slow = controller.derivative_filter_s
        a[derivative, speed], a[derivative, derivative] = 1.0 / slow, -1.0 / slow
        demand = np.zeros(size)
        demand[integral] = 1.0
        demand[speed] = -controller.gain_nm_s_rad + controller.compensated_kg_m2 / slow
        demand[derivative] = -controller.compensated_kg_m2 / slow
        source, of_set = demand, controller.gain_nm_s_rad
        for k, lag in enumerate(lags):
            a[first + k] = source / lag
            a[first + k, first + k] -= 1.0 / lag
            b[first + k] = of_set / lag
            source, of_set = np.eye(size)[first + k], 0.0
        a[speed] += source / mass[0]
        b[speed] += of_set / mass[0]
    return a, b, n


def chain_modes(a, highest_hz):
    """Return (frequency in Hz, damping ratio) of every oscillating eigenvalue, sorted by frequency."""
    poles = np.linalg.eigvals(a)
    found = [(abs(s) / (2 * pi), -s.real / abs(s)) for s in poles if s.imag > 1e-6]
    return sorted(one for one in found if one[0] <= highest_hz)
