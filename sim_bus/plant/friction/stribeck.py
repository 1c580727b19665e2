r"""Stribeck friction: a breakaway torque that falls to Coulomb's as the shaft begins to slide.

::

    T_f = sgn ω · (F_c + (F_s − F_c) e^−(ω/ω_s)²)        |ω| > 0;  B ω beside it
    ω = 0 and T_f = u                                    at rest, as long as |u| ≤ F_s

    F_c, F_s, u N·m; ω, ω_s rad/s; B N·m·s/rad

Source: R. Stribeck (1902) for the falling branch, L. C. Bo and D. Pavelescu (1982) for the exponential with an
exponent (here 2), B. Armstrong-Hélouvry (1991) for its use in control. With torques of some kN·m and ω_s of some rad/s
it is the usual torque on a bit, whose falling branch feeds stick-slip (E. M. Navarro-López and R. Suárez, 2004).

J dω/dt = f(ω) is smooth between two zeros of ω, and scalar: ω changes monotonically towards zero speed or a balance of
torques. A step follows its tangent, λ = f'(ω0)/J, exactly (exponential Rosenbrock–Euler, second order):

    ω(h) = ω0 + f(ω0)/J · (e^(λh) − 1)/λ        zero at t0 = ln(1 − ω0 λ J/f(ω0))/λ

The step is divided so that ω changes by at most ω_s/50 where friction is nonlinear, and a falling branch (λ > 0) grows
by at most e^½: one or a few pieces per step of 2 ms on a rig of some kg·m², two hundred when a light shaft breaks
away.
"""

from math import copysign, exp, expm1, log1p

from sim_bus.plant.friction.shaft import ShaftParams

_SHORT = 1e-3
_FINE = 0.02
"""Largest change of speed within one piece, in units of ω_s."""
_BENT = 3.0
"""Speed in units of ω_s beyond which friction is Coulomb's to 1e-4 of F_s − F_c."""


def sliding(shaft: ShaftParams, speed: float) -> float:
    """Return the friction torque of a shaft that slides at ``speed``, N·m, positive."""
    falls = shaft.static_nm - shaft.coulomb_nm
    return shaft.coulomb_nm + falls * exp(-((speed / shaft.stribeck_speed_rad_s) ** 2))


def advance(shaft: ShaftParams, speed: float, _bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """Return (speed, 0, travel) after ``dt_s`` under the constant torque ``drive``."""
    static, width = shaft.static_nm, shaft.stribeck_speed_rad_s
    viscous, inertia, coulomb = shaft.viscous_nm_s_rad, shaft.inertia_kg_m2, shaft.coulomb_nm
    left, travel = dt_s, 0.0
    side = copysign(1.0, speed)
    while left > 0.0:
        if speed == 0.0:
            if -static <= drive <= static:
                return 0.0, 0.0, travel
            side = copysign(1.0, drive)
        ratio = abs(speed) / width
        extra = (static - coulomb) * exp(-ratio * ratio)
        net = drive - viscous * speed - side * (coulomb + extra)
        if net == 0.0:
            return speed, 0.0, travel + speed * left
        rate = (2.0 * extra * ratio / width - viscous) / inertia
        span = max(_FINE, 0.5 * (ratio - _BENT)) * width
        piece = min(left, span * inertia / abs(net))
        if rate * piece > 0.5:
            piece = 0.5 / rate
        growth = rate * piece
        if abs(growth) > _SHORT:
            gain = expm1(growth) / rate
            mean = (gain - piece) / (rate * piece)
        else:      # first terms of the series: the quotients would lose digits
            gain = piece * (1.0 + growth * (0.5 + growth * (1.0 / 6.0 + growth / 24.0)))
            mean = piece * (0.5 + growth * (1.0 / 6.0 + growth / 24.0))
        acceleration = net / inertia
        end = speed + acceleration * gain
        if end * side >= 0.0:
            travel += (speed + acceleration * mean) * piece
            speed = end
        else:
            bend = -speed * rate / acceleration
            crossing = log1p(bend) / rate if abs(bend) > _SHORT else -speed / acceleration * (1.0 - 0.5 * bend)
            piece = min(max(crossing, 0.0), piece)
            travel += 0.5 * speed * piece
            speed = 0.0
        left -= piece
    return speed, 0.0, travel


def torque(shaft: ShaftParams, speed: float, _bristle: float, drive: float) -> float:
    """Return the dry friction against motion, N·m. At standstill it balances ``drive``."""
    if speed == 0.0:
        return max(-shaft.static_nm, min(shaft.static_nm, drive))
    return copysign(sliding(shaft, speed), speed)
