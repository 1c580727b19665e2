r"""Dahl friction: a bristle that bends before it slips.

::

    dz/dt = ω (1 − (σ z/F_c) sgn ω)        T_f = σ z

    z rad, ω rad/s, σ N·m/rad, F_c and T_f N·m

Source: the paper, section 2.2.3, with its sgn inside the bracket; P. R. Dahl (1968).

Over a piece of constant ω, with s = sgn ω, z_c = F_c/σ and a = |ω| h / z_c,

    z(h) = s z_c + (z0 − s z_c) e^−a        mean z = s z_c + (z0 − s z_c)(1 − e^−a)/a

Both are exact for any relaxation rate of the bristle (|z| ≤ z_c stays true). The mean friction torque is the input of
the linear equation of the shaft; ω is the speed at mid-piece, which two passes find (second order). Pieces in which ω
changes sign are divided at the zero, because the target s z_c changes sign there. The two passes converge while the
bristle's spring is slow compared with the piece; σ h²/J ≤ 0.005 keeps them exact to 1e-4. A stiffer bristle gets more
pieces.
"""

from math import ceil, copysign, exp, expm1, sqrt

from sim_bus.plant.friction.coulomb import TINY
from sim_bus.plant.friction.shaft import ShaftParams

_SLOW = 0.005


def advance(shaft: ShaftParams, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """Return (speed, bristle, travel) after ``dt_s`` under the constant torque ``drive``."""
    stiff = shaft.dahl_stiffness_nm_rad * dt_s * dt_s
    if stiff > _SLOW * shaft.inertia_kg_m2:
        count = ceil(sqrt(stiff / _SLOW / shaft.inertia_kg_m2)) + 1
        travel = 0.0
        for _ in range(count):
            speed, bristle, more = advance(shaft, speed, bristle, drive, dt_s / count)
            travel += more
        return speed, bristle, travel
    end, bristle_end = _piece(shaft, speed, bristle, drive, dt_s)
    if speed * end >= 0.0:
        return end, bristle_end, 0.5 * (speed + end) * dt_s
    crossing = dt_s * speed / (speed - end)
    _, bristle_zero = _piece(shaft, speed, bristle, drive, crossing)
    rest = dt_s - crossing
    end, bristle_end = _piece(shaft, 0.0, bristle_zero, drive, rest)
    return end, bristle_end, 0.5 * (speed * crossing + end * rest)


def torque(shaft: ShaftParams, _speed: float, bristle: float, _drive: float) -> float:
    """Return the dry friction, N·m."""
    return shaft.dahl_stiffness_nm_rad * bristle


def _piece(shaft: ShaftParams, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float]:
    """Return (speed, bristle) after ``dt_s`` in which the speed keeps its sign."""
    stiffness = shaft.dahl_stiffness_nm_rad
    limit = shaft.coulomb_nm / stiffness
    viscous, inertia = shaft.viscous_nm_s_rad, shaft.inertia_kg_m2
    free = drive - viscous * speed
    taken = viscous * dt_s
    response = -expm1(-taken / inertia) / viscous if taken > TINY * inertia else dt_s / inertia
    middle = speed + 0.5 * (free - stiffness * bristle) * response
    end, bristle_end = speed, bristle
    for _ in range(2):
        target = copysign(limit, middle)
        path = abs(middle) * dt_s / limit
        gap = bristle - target
        if path > 1e-6:
            decay = exp(-path)
            bristle_end = target + gap * decay
            mean = target + gap * (1.0 - decay) / path
        else:
            bristle_end = bristle - gap * path
            mean = bristle - 0.5 * gap * path
        end = speed + (free - stiffness * mean) * response
        middle = 0.5 * (speed + end)
    return end, bristle_end
