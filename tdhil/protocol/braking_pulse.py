"""The braking probe's pulse: how strong, how long, and what it would do on a drive that takes it the wrong way. Pure.

A drive that reads its signed torque setpoint as unsigned takes every braking torque for full torque forward. So one
braking torque is tried at low speed, for a time that is fixed before it begins: nothing that the drive reports has to
come in time for it to end. With

    ω_0 the speed, T_f the torque that flows (friction), T_b the braking torque, t_p how long it is asked for,
    t_r the reaction time, from a setpoint to the torque that follows it (a lost frame included), J_min the smallest
    inertia that the rough one leaves open, T_lim the torque limit that the drive has confirmed in preflight,

the most that a misreading can do is T_lim forward from the first braking setpoint until the one behind the last has
acted, with no friction at all, and that must stay well below the speed limit:

    ω_0 + T_lim / J_min · (t_p + t_r)  ≤  ω_0 + 0.8 (ω_max − ω_0)                                            (up)

On a drive that takes it rightly the shaft must stay in its window, and turn forward; t_c is a cycle, which may be lost:

    ω_0 − (T_f + T_b) / J_min · (t_p + t_c)  ≥  ω_0 − 0.6 (ω_0 − ω_min)                                      (down)

and the guard, which looks t_r and the longest reporting lag τ ahead, must not see it turn back: T_b is what friction
holds at standstill, or less than would take the shaft there in t_r + τ. The change by which the answer is known,
(T_f + T_b) t_p / J, must stand out of the noise. A shaft for which that can't be had gets no braking torque at all, in
the whole run.

With a drill string the torque comes down and up again on ramps, of torque_ramp_nm_s or, where friction would bring the
shaft to rest meanwhile, as slow as half a second each allows. That ramp is for letting go of trapped torque for good;
here the string keeps its twist, since the shaft neither stops nor turns back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from tdhil.run.excitation import RigGuess
from tdhil.run.settings import ControlAssumptions, MachineLimits

UP_SHARE, DOWN_SHARE = 0.8, 0.6
SEEN_SHARE = 0.06
"""The change of speed that is aimed at, as a share of the speed limit, where noise asks for no more."""

LEAST_SHARE = 0.15
"""Of the torque limit, that the braking torque should have at least; else it is as strong as what flows."""

LEAST_FLOWING_SHARE = 0.5
"""Of what flows. With less, a drive that takes the size without the sign would slow down almost as much."""

HELD_SHARE = 0.9
"""Of the friction that holds the shaft at standstill."""

LONGEST_S = 1.0
STRING_EDGE_S = 0.5
CLEAR, WANTED_CLEAR = 2.0, 6.0
"""The change must be, and should be, so many times what counts as noise."""


@dataclass(frozen=True)
class Pulse:
    """``torque_nm`` is the braking torque, below zero. ``cycles`` at it, and the ``edge_cycles`` of each ramp.

    ``slowing_rad_s``: by how much it slows the shaft. ``highest_rad_s``: what the wrong reading would come to at worst.
    """

    flowing_nm: float
    torque_nm: float
    cycles: int
    edge_cycles: int
    slowing_rad_s: float
    highest_rad_s: float

    def setpoints_nm(self) -> list[float]:
        """One a cycle, from the first below what flows to the one that is what flows again."""
        step_nm = (self.torque_nm - self.flowing_nm) / (self.edge_cycles + 1)
        edge = [self.flowing_nm + step_nm * (n + 1) for n in range(self.edge_cycles)]
        return [*edge, *[self.torque_nm] * self.cycles, *reversed(edge), self.flowing_nm]


@dataclass(frozen=True)
class NoPulse:
    """Why there is none that is safe and can be seen, and what would help."""

    why: str
    next_step: str


@dataclass(frozen=True)
class Before:
    """The steady rotation that it starts from: what flows (less its offset), and what counts as noise of a report."""

    speed_rad_s: float
    flowing_nm: float
    speed_noise_rad_s: float


def plan_pulse(
    limits: MachineLimits, model: RigGuess, assumptions: ControlAssumptions, before: Before, period_s: float
) -> Pulse | NoPulse:
    """The pulse for this shaft on this line (``period_s`` a cycle)."""
    lightest = assumptions.smallest_inertia_share * model.inertia_kg_m2
    reaction_s = assumptions.reaction_s
    room_up = UP_SHARE * (limits.speed_max_rad_s - before.speed_rad_s)
    room_down = DOWN_SHARE * (before.speed_rad_s - max(0.0, limits.speed_min_rad_s))
    ahead_s = reaction_s + assumptions.largest_speed_lag_s
    slowest = before.speed_rad_s - room_down - before.speed_noise_rad_s
    turning_back_nm = slowest * lightest / ahead_s - model.steady_torque_nm(before.speed_rad_s)
    braking_nm = min(
        max(before.flowing_nm, LEAST_SHARE * limits.torque_nm),
        max(HELD_SHARE * model.coulomb_nm, turning_back_nm),
        limits.probe_torque_nm,
        limits.torque_nm,
    )
    change_nm = before.flowing_nm + braking_nm
    up_s = room_up * lightest / limits.torque_nm - reaction_s
    down_s = room_down * lightest / change_nm - period_s
    if up_s < period_s:
        bearable_nm = room_up * lightest / (reaction_s + period_s)
        return NoPulse(
            f"{limits.torque_nm:g} N·m, the torque limit, could speed a shaft of {model.inertia_kg_m2:.3g} kg·m² up to "
            f"its limit within {reaction_s + period_s:.2g} s, should the drive take a braking torque the wrong way",
            f"Lower limits.torque_nm to {bearable_nm:.2g} N·m or less, if that moves the shaft; else use --mode speed",
        )
    if down_s < period_s:
        return NoPulse(
            f"friction and {braking_nm:.3g} N·m would take the shaft out of its window within {2.0 * period_s:.2g} s",
            "Use --mode speed",
        )
    wanted_rad_s = max(SEEN_SHARE * limits.speed_max_rad_s, WANTED_CLEAR * before.speed_noise_rad_s)
    wanted_s = wanted_rad_s * model.inertia_kg_m2 / change_nm
    longest_s = min(max(wanted_s, period_s), LONGEST_S, up_s, down_s)
    edge = _edge_cycles(limits, change_nm, min(up_s, down_s), period_s)
    # Both edges together change as much as the full torque would in the time of one, and both may be misread.
    cycles = max(1, min(_whole(longest_s, period_s) - edge, _whole(up_s, period_s) - 2 * edge))
    slowing = change_nm * (cycles + edge) * period_s / model.inertia_kg_m2
    if slowing < CLEAR * before.speed_noise_rad_s or braking_nm < LEAST_FLOWING_SHARE * before.flowing_nm:
        return NoPulse(
            f"{braking_nm:.3g} N·m would slow the shaft by {slowing:.2g} rad/s, too little to tell",
            "Use --mode speed, or raise limits.probe_torque_nm",
        )
    exposed_s = (cycles + 2 * edge) * period_s + reaction_s
    highest = before.speed_rad_s + limits.torque_nm / lightest * exposed_s
    return Pulse(before.flowing_nm, -braking_nm, cycles, edge, slowing, highest)


def _edge_cycles(limits: MachineLimits, change_nm: float, longest_s: float, period_s: float) -> int:
    """Cycles of a ramp down or up, none without a string; both, and a cycle between, take ``longest_s`` at most."""
    if limits.load != "string":
        return 0
    wanted_s = change_nm / limits.torque_ramp_nm_s if limits.torque_ramp_nm_s > 0.0 else STRING_EDGE_S
    room = (_whole(longest_s, period_s) - 1) // 2
    return max(0, min(round(min(wanted_s, STRING_EDGE_S) / period_s), room))


def _whole(time_s: float, period_s: float) -> int:
    """Whole cycles in a time."""
    return math.floor(time_s / period_s + 1e-9)
