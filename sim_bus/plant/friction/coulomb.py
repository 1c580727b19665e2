r"""Coulomb friction beside viscous friction; exact, with sticking.

::

    J dω/dt = u − B ω − F_c sgn ω        |ω| > 0
    ω = 0 and T_f = u                    at rest, as long as |u| ≤ F_c

    J kg·m², u and F_c N·m, B N·m·s/rad, ω rad/s

Source: the paper, sections 2.2.1 and 2.2.2; C. A. Coulomb (1785) for the constant torque against sliding, O. Reynolds
(1886) for the part that grows with speed.

Between two zeros of ω the equation is linear, so that a step is exact: with x = B h / J and s = sgn ω

    ω(h) = ω0 + (u − s F_c − B ω0) · (1 − e^−x)/B                      (→ h/J for B → 0)

ω passes zero at t0 = (J/B) ln(1 − ω0 B/(u − s F_c)) (→ −ω0 J/(u − s F_c)). There the shaft sticks if
|u| ≤ F_c. Otherwise the rest of the step continues from zero in the direction of u. So there is no chatter.

The travel follows from the momentum balance, B ∫ω dt = (u − s F_c) h − J (ω(h) − ω0). If viscous friction is small in a
step (x ≤ 0.02), this is a difference of nearly equal numbers, and the mean of both speeds is used (relative error
x²/12).
"""

from math import copysign, expm1, log1p

from sim_bus.plant.friction.shaft import ShaftParams

TINY = 1e-15
"""Smallest share of viscous friction in a step. Below it the exponential equals its first term, and quotients would
underflow."""
LIGHTLY_DAMPED = 0.02


def advance(shaft: ShaftParams, speed: float, _bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """Return (speed, 0, travel) after ``dt_s`` under the constant torque ``drive``."""
    dry = shaft.coulomb_nm
    if speed == 0.0:
        if -dry <= drive <= dry:
            return 0.0, 0.0, 0.0
        side = copysign(1.0, drive)
    else:
        side = copysign(1.0, speed)
    net = drive - side * dry
    viscous, inertia = shaft.viscous_nm_s_rad, shaft.inertia_kg_m2
    taken = viscous * dt_s
    # (1 − e^−x)/B: speed gained per unit of net torque.
    response = -expm1(-taken / inertia) / viscous if taken > TINY * inertia else dt_s / inertia
    end = speed + (net - viscous * speed) * response
    if end * side >= 0.0:
        if taken <= LIGHTLY_DAMPED * inertia:
            return end, 0.0, 0.5 * (speed + end) * dt_s
        return end, 0.0, (net * dt_s - inertia * (end - speed)) / viscous
    damped = abs(speed) * viscous > TINY * abs(net)
    crossing = log1p(-speed * viscous / net) * inertia / viscous if damped else -speed * inertia / net
    if viscous * crossing <= LIGHTLY_DAMPED * inertia:
        travel = 0.5 * speed * crossing
    else:
        travel = (net * crossing + inertia * speed) / viscous
    if -dry <= drive <= dry:
        return 0.0, 0.0, travel
    end, _, more = advance(shaft, 0.0, 0.0, drive, max(dt_s - crossing, 0.0))
    return end, 0.0, travel + more


def torque(shaft: ShaftParams, speed: float, _bristle: float, drive: float) -> float:
    """Return the dry friction against motion, N·m. At standstill it balances ``drive``."""
    if speed == 0.0:
        return max(-shaft.coulomb_nm, min(shaft.coulomb_nm, drive))
    return copysign(shaft.coulomb_nm, speed)
