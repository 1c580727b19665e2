r"""The shaft: one rigid inertia with viscous friction and Coulomb or Dahl friction.

::

    J dω/dt = u − B ω − T_f        u = torque − load, held constant over a step

**Coulomb.** T_f = F_c sgn ω while it turns; at rest T_f = u as long as |u| ≤ F_c (sticking). Between two
zeros of ω the equation is linear, so that a step is exact: with x = B h / J

    ω(h) = ω0 + (u − s F_c − B ω0) · (1 − e^−x)/B          s = sgn ω  (→ h/J for B → 0)

and ω passes zero at t0 = (J/B) ln(1 − ω0 B/(u − s F_c)) (→ −ω0 J/(u − s F_c)). There the shaft
sticks if |u| ≤ F_c, otherwise the rest of the step goes on from zero to the side of u. Hence no chatter.

**Dahl** (the paper's friction model, its sgn read inside the bracket): dz/dt = ω (1 − (σ z/F_c) sgn ω),
T_f = σ z. Over a step of constant ω, with z_c = F_c/σ and a = |ω| h / z_c,

    z(h) = s z_c + (z0 − s z_c) e^−a        mean z = s z_c + (z0 − s z_c)(1 − e^−a)/a

both exact however fast the bristle relaxes (|z| ≤ z_c stays true). The mean friction torque drives the
linear equation above; ω is taken at mid-step, found by two passes (second order). Steps in which ω
changes sign are cut at the zero, because the target s z_c changes sign there.
"""

from math import copysign, exp, expm1, log1p
from typing import Literal, NamedTuple

from sim_bus.validated import NonNegative, Positive, Validated


class Params(Validated):
    """What the shaft is. The defaults are the field-like rig of the identification study."""

    inertia_kg_m2: Positive = 104.0
    viscous_nm_s_rad: NonNegative = 8.0
    coulomb_nm: NonNegative = 60.0
    friction: Literal["coulomb", "dahl"] = "coulomb"
    dahl_stiffness_nm_rad: Positive = 5000.0
    load_nm: float = 0.0
    """A constant load, against positive speed."""


class State(NamedTuple):
    """Where the shaft is: speed, angle, and the deflection of Dahl's bristle (0 with Coulomb friction)."""

    speed_rad_s: float = 0.0
    angle_rad: float = 0.0
    bristle_rad: float = 0.0


def step(params: Params, state: State, torque_nm: float, dt_s: float, load_nm: float = 0.0) -> State:
    """The state ``dt_s`` later, under constant torque.

    ``load_nm`` acts against positive speed, on top of the constant load.
    """
    speed, angle, bristle = state
    drive = torque_nm - load_nm - params.load_nm
    if params.friction == "coulomb" or params.coulomb_nm == 0.0:
        end, travel = _coulomb(params, speed, drive, dt_s)
        return State(end, angle + travel, 0.0)
    end, bristle_end, travel = _dahl(params, speed, bristle, drive, dt_s)
    return State(end, angle + travel, bristle_end)


def friction_torque(params: Params, state: State, drive_nm: float = 0.0) -> float:
    """Dry friction in N·m, as it acts against motion; at rest with Coulomb friction it balances ``drive_nm``."""
    if params.friction == "dahl" and params.coulomb_nm > 0.0:
        return params.dahl_stiffness_nm_rad * state.bristle_rad
    if state.speed_rad_s == 0.0:
        return max(-params.coulomb_nm, min(params.coulomb_nm, drive_nm))
    return copysign(params.coulomb_nm, state.speed_rad_s)


_TINY = 1e-15


def _response(params: Params, dt_s: float) -> float:
    """(1 − e^−x)/B: speed gained in ``dt_s`` per unit of net torque, rad/(s·N·m)."""
    viscous = params.viscous_nm_s_rad
    inertia = params.inertia_kg_m2
    # Below this share the exponential is its first term to the last bit, and the quotient would underflow.
    return -expm1(-viscous * dt_s / inertia) / viscous if viscous * dt_s > _TINY * inertia else dt_s / inertia


def _coulomb(params: Params, speed: float, drive: float, dt_s: float) -> tuple[float, float]:
    """(speed, travel) after ``dt_s``; exact, see the module's docstring."""
    dry = params.coulomb_nm
    if speed == 0.0:
        if -dry <= drive <= dry:
            return 0.0, 0.0
        side = copysign(1.0, drive)
    else:
        side = copysign(1.0, speed)
    net = drive - side * dry
    viscous = params.viscous_nm_s_rad
    end = speed + (net - viscous * speed) * _response(params, dt_s)
    if end * side >= 0.0:
        return end, 0.5 * (speed + end) * dt_s
    inertia = params.inertia_kg_m2
    damped = abs(speed) * viscous > _TINY * abs(net)
    crossing = log1p(-speed * viscous / net) * inertia / viscous if damped else -speed * inertia / net
    travel = 0.5 * speed * crossing
    if -dry <= drive <= dry:
        return 0.0, travel
    end, more = _coulomb(params, 0.0, drive, max(dt_s - crossing, 0.0))
    return end, travel + more


def _dahl(params: Params, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float, float]:
    """(speed, bristle, travel) after ``dt_s``; a step through zero speed is cut there."""
    end, bristle_end = _dahl_piece(params, speed, bristle, drive, dt_s)
    if speed * end >= 0.0:
        return end, bristle_end, 0.5 * (speed + end) * dt_s
    crossing = dt_s * speed / (speed - end)
    _, bristle_zero = _dahl_piece(params, speed, bristle, drive, crossing)
    rest = dt_s - crossing
    end, bristle_end = _dahl_piece(params, 0.0, bristle_zero, drive, rest)
    return end, bristle_end, 0.5 * (speed * crossing + end * rest)


def _dahl_piece(params: Params, speed: float, bristle: float, drive: float, dt_s: float) -> tuple[float, float]:
    """(speed, bristle) after ``dt_s`` in which the speed keeps its sign."""
    stiffness = params.dahl_stiffness_nm_rad
    limit = params.coulomb_nm / stiffness
    free = drive - params.viscous_nm_s_rad * speed
    response = _response(params, dt_s)
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
