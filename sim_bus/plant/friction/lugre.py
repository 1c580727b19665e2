r"""LuGre friction: Dahl's bristle with damping, slipping at Stribeck's torque.

::

    dz/dt = ω − σ0 |ω| z / g(ω)        g(ω) = F_c + (F_s − F_c) e^−(ω/ω_s)²
    T_f   = σ0 z + σ1 dz/dt            and σ2 ω beside it, which is viscous_nm_s_rad

    z rad, ω and ω_s rad/s, g, F_c, F_s, T_f N·m, σ0 N·m/rad, σ1 and σ2 N·m·s/rad

Source: C. Canudas de Wit, H. Olsson, K. J. Åström and P. Lischinsky (1995), cited by the paper in section 2.2.3.
With σ1 = 0 and F_s = F_c it is Dahl's model. The shaft never sticks in the strict sense: at standstill the bristle
carries the load.

Over a piece of constant ω, with s = sgn ω, z_c = g(ω)/σ0 and a = |ω| h / z_c, the bristle is exact as Dahl's is:

    z(h) = s z_c + (z0 − s z_c) e^−a        mean z = s z_c + (z0 − s z_c)(1 − e^−a)/a

So |z| ≤ F_s/σ0 always, and mean dz/dt = κ ω with κ = 1 − s mean z / z_c. The damper then adds to the viscous friction,
which is B + σ1 κ, and both are solved exactly:

    J dω/dt = u − σ0 mean z − (B + σ1 κ) ω

ω, z_c, κ are those of the piece's mean speed, which fixed-point passes find (second order). A pass multiplies the error
by σ0 h · min(h/2J, 1/(B + σ1)), which the division into pieces keeps below 0.1. Pieces are divided where ω changes
sign.
"""

from math import ceil, copysign, exp, expm1, sqrt

from sim_bus.plant.friction.shaft import ShaftParams
from sim_bus.plant.friction.stribeck import sliding

_CONTRACTION = 0.1
_STEEP = 0.1
_MOST_PIECES = 400
_SHORT = 1e-3


def advance(shaft: ShaftParams, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """Return (speed, bristle, travel) after ``dt_s`` under the constant torque ``drive``."""
    count = _pieces(shaft, dt_s)
    piece_s, travel = dt_s / count, 0.0
    for _ in range(count):
        end, bristle_end, more = _piece(shaft, speed, bristle, drive, piece_s)
        if speed * end < 0.0:
            crossing = piece_s * speed / (speed - end)
            _, bristle_zero, before = _piece(shaft, speed, bristle, drive, crossing)
            end, bristle_end, after = _piece(shaft, 0.0, bristle_zero, drive, piece_s - crossing)
            more = before + after
        speed, bristle = end, bristle_end
        travel += more
    return speed, bristle, travel


def torque(shaft: ShaftParams, speed: float, bristle: float, _drive: float) -> float:
    """Return the dry friction with the bristle's damper, N·m, without viscous friction."""
    bend = speed - shaft.lugre_stiffness_nm_rad * abs(speed) * bristle / sliding(shaft, speed)
    return shaft.lugre_stiffness_nm_rad * bristle + shaft.lugre_damping_nm_s_rad * bend


def _pieces(shaft: ShaftParams, dt_s: float) -> int:
    """Return the number of pieces for which the passes converge: on the spring, and on the falling branch (at most 0.86
    ΔF/ω_s).
    """
    inertia, stiffness = shaft.inertia_kg_m2, shaft.lugre_stiffness_nm_rad
    damping = shaft.viscous_nm_s_rad + shaft.lugre_damping_nm_s_rad
    by_inertia = sqrt(0.5 * stiffness / inertia / _CONTRACTION)
    by_damping = stiffness / (_CONTRACTION * damping) if damping > 0.0 else by_inertia
    falling = 0.86 * (shaft.static_nm - shaft.coulomb_nm) / (shaft.stribeck_speed_rad_s * inertia * _STEEP)
    return max(1, min(_MOST_PIECES, ceil(dt_s * max(min(by_inertia, by_damping), falling))))


def _piece(shaft: ShaftParams, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """Return (speed, bristle, travel) after ``dt_s`` in which the speed keeps its sign."""
    stiffness, damping = shaft.lugre_stiffness_nm_rad, shaft.lugre_damping_nm_s_rad
    viscous, inertia = shaft.viscous_nm_s_rad, shaft.inertia_kg_m2
    end, bristle_end, middle = speed, bristle, speed
    for _ in range(3):
        limit = sliding(shaft, middle) / stiffness
        # at standstill: the direction in which it will slide
        target = copysign(limit, middle or drive - stiffness * bristle)
        path = abs(middle) * dt_s / limit
        gap = bristle - target
        if path > 1e-6:
            decay = exp(-path)
            bristle_end = target + gap * decay
            mean = target + gap * (1.0 - decay) / path
        else:
            bristle_end = bristle - gap * path
            mean = bristle - 0.5 * gap * path
        resisting = viscous + damping * (1.0 - mean / target)
        net = drive - stiffness * mean - resisting * speed
        taken = resisting * dt_s / inertia
        if abs(taken) > _SHORT:
            gain = -expm1(-taken) / taken
            share = (1.0 - gain) / taken
        else:      # first terms of the series: the quotients would lose digits
            gain = 1.0 - taken * (0.5 - taken / 6.0)
            share = 0.5 - taken * (1.0 / 6.0 - taken / 24.0)
        change = net * dt_s / inertia
        end = speed + change * gain
        middle = speed + change * share
    return end, bristle_end, middle * dt_s
