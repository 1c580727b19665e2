r"""Torque that depends on the angle of the motor's shaft: cogging (slots and poles) and eccentricity.

::

    T_a(θ) = Σ a_n cos(n θ + φ_n)        against positive rotation, added to the load of any plant

    a N·m, θ and φ rad; θ = 0 where the shaft is when the drive is switched on

Source: cogging as a series over the angle, as in D. C. Hanselman, Brushless Permanent Magnet Motor Design (2003),
chapter 8. The torque of a step of h is its mean over the travel ω h at constant speed, which is exact there:

    mean = a_n cos(n (θ + ω h/2) + φ_n) · sin x / x,      x = n ω h/2
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from typing import Generic, Protocol, TypeVar

from sim_bus.plant.friction import Harmonic


class _Rotation(Protocol):
    @property
    def speed_rad_s(self) -> float: ...
    @property
    def angle_rad(self) -> float: ...


S = TypeVar("S", bound=_Rotation)

_SERIES = 1e-3
"""x below which sin x / x is taken as 1; the error is below 2e-7."""


def torque_over_step(harmonics: tuple[Harmonic, ...], angle_rad: float, travel_rad: float) -> float:
    """Return the mean torque against positive rotation while the shaft turns from ``angle_rad`` by ``travel_rad``,
    N·m.
    """
    half, total = 0.5 * travel_rad, 0.0
    for one in harmonics:
        x = one.order * half
        share = sin(x) / x if abs(x) > _SERIES else 1.0
        total += one.amplitude_nm * share * cos(one.order * (angle_rad + half) + one.phase_rad)
    return total


class AngleTorque(Generic[S]):
    """Another plant, by its rest and its step, with the torque of ``harmonics`` at its motor end."""

    def __init__(self, rest: Callable[[], S], step: Callable[..., S], harmonics: tuple[Harmonic, ...]) -> None:
        def step_on(state: S, torque_nm: float, dt_s: float, load_nm: float = 0.0, *bottom_nm: float) -> S:
            against = torque_over_step(harmonics, state.angle_rad, state.speed_rad_s * dt_s)
            return step(state, torque_nm, dt_s, load_nm + against, *bottom_nm)

        self.rest = rest
        self.step = step_on
