r"""Top drive, string and bit in time: waves along characteristics, many set speeds and controllers side by side.

::

    a = τ + ζω runs down, b = ζω − τ runs up, each unchanged at speed c along a line

**Nodes.** Lines are cut at nodes a whole number of ticks apart, so that a wave is a ring of past values: written at one
end, read at the other m ticks later; nothing is interpolated, nothing disperses. At a node the speeds are equal and
τ_above − τ_below = βω, with β the drag of half of what lies above and half of what lies below, lumped:

    ω = (a + b)/(ζ₁ + ζ₂ + β)        a' = 2 ζ₂ ω − b        b' = 2 ζ₁ ω − a

which holds for a change of section (ζ₁ ≠ ζ₂) as for drag within one. A node never adds energy: what goes out is ½(a² +
b²)-wise what came in less βω².

**Top.** J dω/dt = T + b − (B + ζ + β/2) ω − F_c sgn ω, with the controller's states and lags beside it, is linear for a
wave that is constant over a tick: its step is a matrix exponential. It sends down 2ζ (mean ω) − b.

**Bit.** J_L dω/dt = a − (ζ + β/2 + B_b) ω − T_f(ω): each tick follows the tangent of the friction's curve exactly
(exponential Rosenbrock–Euler), in parts that change little; at zero speed it sticks while |a| ≤ F_s. A bottom without
inertia of its own is given that of half a tick of its line, which is that much shorter for it.

No torque limit is simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, e, pi, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.drill_string import BitFriction, DrillString

LONGEST_TICK_S = 0.006
SHORTEST_TICK_S = 0.002
DRAG_EVERY_S = 0.15
"""Drag is lumped at nodes about so far apart; the echo of a lump is of the order of β/2ζ."""
SLIDING_BLUR_RAD_S = 0.05
"""Over which the top's own dry friction changes its sign."""

Array = NDArray[np.float64]
Loop = tuple[TopDrive, SpeedController]


@dataclass(frozen=True)
class Grid:
    """A string cut into segments of whole ticks."""

    tick_s: float
    ticks: tuple[int, ...]
    impedance_nm_s_rad: tuple[float, ...]
    drag_nm_s_rad: tuple[float, ...]
    """Of each segment as a whole."""
    bottom_inertia_kg_m2: float

    @property
    def delay_s(self) -> float:
        """From top to bottom."""
        return self.tick_s * sum(self.ticks)


def grid_of(string: DrillString, longest_tick_s: float = LONGEST_TICK_S) -> Grid:
    """The tick at which all lines together are rounded least, and the segments at it."""
    delays = np.array([line.delay_s for line in string.lines])
    last = string.lines[-1].impedance_nm_s_rad

    def rounded(tick: float) -> tuple[NDArray[np.int64], float, float]:
        # where the bit has next to no inertia, half a tick of pipe becomes one
        own = max(0.0, 0.5 * tick - string.bottom_inertia_kg_m2 / last)
        wanted = delays - np.append(np.zeros(len(delays) - 1), own)
        counts = np.maximum(1, np.rint(wanted / tick)).astype(np.int64)
        return counts, float(np.abs(counts * tick - wanted).sum()), own

    if len(delays) == 1 and string.bottom_inertia_kg_m2 >= 0.5 * longest_tick_s * last:
        exact = float(delays[0]) / ceil(float(delays[0]) / longest_tick_s * (1.0 - 1e-9))
        candidates = np.full(1, exact)
    else:
        shortest = min(SHORTEST_TICK_S * longest_tick_s / LONGEST_TICK_S, longest_tick_s)
        candidates = np.linspace(shortest, longest_tick_s, 400)
    tick = float(min(candidates, key=lambda one: rounded(float(one))[1] / one**0.25))
    counts, _, own = rounded(tick)
    ticks: list[int] = []
    impedances: list[float] = []
    drags: list[float] = []
    for line, count in zip(string.lines, counts, strict=True):
        parts = max(1, min(int(count), round(line.delay_s / DRAG_EVERY_S))) if line.drag_nm_s_rad_m else 1
        edges = np.rint(np.linspace(0, count, parts + 1)).astype(int)
        for size in np.diff(edges):
            ticks.append(int(size))
            impedances.append(line.impedance_nm_s_rad)
            drags.append(line.drag_nm_s_rad_m * line.length_m * float(size) / float(count))
    return Grid(tick, tuple(ticks), tuple(impedances), tuple(drags), string.bottom_inertia_kg_m2 + own * last)


@dataclass(frozen=True)
class SimulationTrace:
    """What was kept: first index time, second the loop, third the set speed."""

    time_s: Array
    set_rad_s: Array
    top_rad_s: Array
    bit_rad_s: Array
    top_torque_nm: Array
    """The drive's torque on the rotor."""
    first_stuck_s: Array
    """When the bit stood still for the first time after it had turned; infinite: never."""
    last_stuck_s: Array
    """When the bit stood still for the last time; −1: never."""


@dataclass(frozen=True)
class Begin:
    """How it begins.

    ``stuck``: the bit about to break away, the string wound up to it and still, the top at full speed, its integral in
    balance. ``rest``: nothing turns, nothing is wound up. ``turning``: all of it steadily, at one speed.
    """

    how: Literal["stuck", "rest", "turning"]
    speed_rad_s: Array
    """(loops, speeds); of the top."""


def simulate(
    string: DrillString,
    loops: Sequence[Loop],
    begin: Begin,
    target_rad_s: Array,
    ramp_rad_s2: float,
    duration_s: float,
    keep_every_s: float = 0.1,
    longest_tick_s: float = LONGEST_TICK_S,
    hold_s: float = 0.0,
) -> SimulationTrace:
    """Every loop at every set speed: the set speed goes from ``begin``'s to the target along the ramp, after a hold.

    ``target_rad_s``: (loops, speeds). A bit must be stated. Raises ValueError where none is.
    """
    if string.bit is None:
        raise ValueError("no bit is stated")
    grid = grid_of(string, longest_tick_s)
    shape = target_rad_s.shape
    top = _Top(loops, grid, shape[1])
    now = np.broadcast_to(begin.speed_rad_s, shape).astype(float).copy()
    set_speed = now.copy() if begin.how != "rest" else np.zeros(shape)
    pipe = PipeSimulation(string, grid, shape[0] * shape[1])
    speed, held = np.zeros(shape), np.zeros(shape)
    if begin.how == "stuck":
        speed, held = now, np.full(shape, string.bit.static_nm)
        pipe.wind_up(held.ravel())
    elif begin.how == "turning":
        speed = now
        held = pipe.turn(now.ravel()).reshape(shape)
    top.begin(speed, held)
    step = ramp_rad_s2 * grid.tick_s
    count, held_ticks = ceil(duration_s / grid.tick_s), round(hold_s / grid.tick_s)
    every = max(1, round(keep_every_s / grid.tick_s))
    kept: list[tuple[float, Array, Array, Array, Array]] = []
    first: Array = np.full(now.size, np.inf)
    last: Array = np.full(now.size, -1.0)
    turned = pipe.bit_rad_s > 0.0
    for tick in range(count):
        if tick >= held_ticks:
            set_speed = set_speed + np.clip(target_rad_s - set_speed, -step, step)
        top_wave, mean_top = top.step(pipe.at_top(), set_speed)
        pipe.tick(top_wave)
        time_s = (tick + 1) * grid.tick_s
        bit_speed = pipe.bit_rad_s
        still = bit_speed == 0.0
        last[still] = time_s
        turned |= bit_speed > 0.0
        first = np.where(still & turned & ~np.isfinite(first), time_s, first)
        if tick % every == 0:
            kept.append((time_s, set_speed, mean_top, bit_speed.reshape(shape), top.torque_nm))
    times, sets, tops, bits, torques = zip(*kept, strict=True)
    return SimulationTrace(np.array(times), np.array(sets), np.array(tops), np.array(bits), np.array(torques),
                           first.reshape(shape), last.reshape(shape))


class _Waves:
    """The rings: what was sent into each segment at its ends, and comes out of it after its ticks."""

    def __init__(self, grid: Grid, cases: int) -> None:
        self._grid = grid
        self._ticks = np.array(grid.ticks)
        self._size = int(self._ticks.max())
        segments = len(grid.ticks)
        self._down = np.zeros((self._size, segments, cases))
        self._up = np.zeros((self._size, segments, cases))
        self._rows = np.arange(segments)
        self._now = 0
        impedance, drag = np.array(grid.impedance_nm_s_rad), np.array(grid.drag_nm_s_rad)
        above, below = impedance[:-1, None], impedance[1:, None]
        beta = 0.5 * (drag[:-1] + drag[1:])[:, None]
        self._over = 1.0 / (above + below + beta)
        self._twice_above, self._twice_below = 2.0 * above, 2.0 * below

    def fill(self, bottom_torque_nm: Array, speed: Array) -> None:
        """One speed all along; torque as the drag at that speed makes it grow upwards."""
        grid = self._grid
        torque = bottom_torque_nm.copy()
        below = 0.0
        for row in range(len(grid.ticks) - 1, -1, -1):
            drag, impedance = grid.drag_nm_s_rad[row], grid.impedance_nm_s_rad[row]
            torque = torque + 0.5 * (drag + below) * speed
            below = drag
            self._down[:, row] = torque + impedance * speed
            self._up[:, row] = impedance * speed - torque

    def top_torque(self, top_speed: Array) -> Array:
        """τ just below the rotor."""
        felt = self._grid.impedance_nm_s_rad[0] + 0.5 * self._grid.drag_nm_s_rad[0]
        torque: Array = felt * top_speed - self.at_top()
        return torque

    def at_top(self) -> Array:
        """What comes out of the topmost segment now, at its upper end."""
        arriving: Array = self._up[(self._now - self._grid.ticks[0]) % self._size, 0]
        return arriving

    def arriving(self) -> tuple[Array, Array]:
        """What comes out of every segment now, at its lower and at its upper end."""
        slots = (self._now - self._ticks) % self._size
        return self._down[slots, self._rows], self._up[slots, self._rows]

    def send(self, down: Array, up: Array, from_top: Array, from_bit: Array) -> None:
        """Through every node, and one tick on."""
        a, b = down[:-1], up[1:]
        speed = (a + b) * self._over
        slot = self._now % self._size
        self._down[slot, 0] = from_top
        self._up[slot, -1] = from_bit
        self._down[slot, 1:] = self._twice_below * speed - b
        self._up[slot, :-1] = self._twice_above * speed - a
        self._now += 1


class PipeSimulation:
    """Waves and bit, a tick at a time: whatever hangs below a top drive, simulated or real; one number a case."""

    def __init__(self, string: DrillString, grid: Grid, cases: int) -> None:
        assert string.bit is not None
        self._viscous = string.bottom_viscous_nm_s_rad
        self._waves = _Waves(grid, cases)
        self._bit = _Bit(string.bit, string.bottom_viscous_nm_s_rad, grid)
        self.bit_rad_s: Array = np.zeros(cases)

    def wind_up(self, torque_nm: Array) -> None:
        """Nothing turns, and all of it is wound up to that torque."""
        self._waves.fill(torque_nm, np.zeros(torque_nm.size))

    def turn(self, speed: Array) -> Array:
        """All of it turns steadily; the torque that this takes at the top."""
        self.bit_rad_s = speed.copy()
        load = self._bit.sliding(speed) * np.sign(speed) + self._viscous * speed
        self._waves.fill(load, speed)
        return self.top_torque(speed)

    def release(self) -> None:
        """Off bottom: the bit's dry friction is gone."""
        self._bit.release()

    def at_top(self) -> Array:
        """b, that comes up out of the topmost segment during the coming tick."""
        return self._waves.at_top()

    def top_torque(self, speed: Array) -> Array:
        """τ just below the rotor, at that speed."""
        return self._waves.top_torque(speed)

    def tick(self, from_top: Array) -> None:
        """One on, with the wave that the top sends down meanwhile."""
        arriving_down, arriving_up = self._waves.arriving()
        bit_wave, self.bit_rad_s = self._bit.step(arriving_down[-1], self.bit_rad_s)
        self._waves.send(arriving_down, arriving_up, from_top, bit_wave)


class _Top:
    """Rotor, controller and lags; (loops, speeds, states)."""

    def __init__(self, loops: Sequence[Loop], grid: Grid, speeds: int) -> None:
        from scipy.linalg import expm

        self._impedance = grid.impedance_nm_s_rad[0]
        self._drag = 0.5 * grid.drag_nm_s_rad[0]
        self._lags = max(1, *(len(drive.inner_lags_s) for drive, _ in loops))
        self._size = 4 + self._lags
        matrices = [self._matrix(drive, controller) for drive, controller in loops]
        # right factors: (states + inputs) → states
        self._step = np.array([expm(matrix * grid.tick_s)[: self._size].T for matrix in matrices])
        self._dry = np.array([drive.coulomb_nm for drive, _ in loops])[:, None]
        self._viscous = np.array([drive.viscous_nm_s_rad for drive, _ in loops])[:, None]
        self._tick_s = grid.tick_s
        self._state = np.zeros((len(loops), speeds, self._size))

    def _matrix(self, drive: TopDrive, controller: SpeedController) -> Array:
        """Of states ω, ∫e·I, filtered ω, ∫ω dt, lags; and the inputs wave, dry friction, set speed."""
        size = self._size
        law = np.zeros((size + 3, size + 3))
        wave, dry, wanted = size, size + 1, size + 2
        lags = [lag for lag in drive.inner_lags_s if lag > 0.0]
        lags += [1e-4] * (self._lags - len(lags))
        inertia = drive.inertia_kg_m2
        law[0, 0] = -(drive.viscous_nm_s_rad + self._impedance + self._drag) / inertia
        law[0, 3 + self._lags] = law[0, wave] = law[0, dry] = 1.0 / inertia
        law[1, 0], law[1, wanted] = -controller.integral_nm_rad, controller.integral_nm_rad
        filter_s = controller.derivative_filter_s
        law[2, 0], law[2, 2] = 1.0 / filter_s, -1.0 / filter_s
        law[3, 0] = 1.0
        back = controller.compensated_kg_m2 / filter_s
        law[4] = np.zeros(size + 3)
        law[4, 0], law[4, wanted] = back - controller.gain_nm_s_rad, controller.gain_nm_s_rad
        law[4, 1], law[4, 2] = 1.0, -back
        law[4] /= lags[0]
        law[4, 4] -= 1.0 / lags[0]
        for number, lag in enumerate(lags[1:], start=5):
            law[number, number - 1], law[number, number] = 1.0 / lag, -1.0 / lag
        return law

    @property
    def torque_nm(self) -> Array:
        """On the rotor."""
        torque: Array = self._state[:, :, 3 + self._lags].copy()
        return torque

    def begin(self, speed: Array, string_torque_nm: Array) -> None:
        """Turning at the set speed, the torque in balance."""
        torque = string_torque_nm + self._viscous * speed + self._dry * np.clip(speed / SLIDING_BLUR_RAD_S, -1.0, 1.0)
        self._state[:, :, 0] = self._state[:, :, 2] = speed
        self._state[:, :, 1] = torque
        self._state[:, :, 4:] = torque[:, :, None]

    def step(self, arriving: Array, set_speed: Array) -> tuple[Array, Array]:
        """(wave that goes down, mean speed)."""
        state = self._state
        shape = set_speed.shape
        wave = arriving.reshape(shape)
        state[:, :, 3] = 0.0
        friction = -self._dry * np.clip(state[:, :, 0] / SLIDING_BLUR_RAD_S, -1.0, 1.0)
        inputs = np.stack([wave, friction, set_speed], axis=2)
        self._state = state = np.concatenate([state, inputs], axis=2) @ self._step
        mean = state[:, :, 3] / self._tick_s
        return (2.0 * self._impedance * mean - wave).ravel(), mean


class _Bit:
    """What turns at the bottom, one number a case."""

    def __init__(self, friction: BitFriction, viscous_nm_s_rad: float, grid: Grid) -> None:
        self._friction = friction
        self._inertia = grid.bottom_inertia_kg_m2
        self._impedance = grid.impedance_nm_s_rad[-1]
        self._viscous = viscous_nm_s_rad + self._impedance + 0.5 * grid.drag_nm_s_rad[-1]
        self._falls = friction.static_nm - friction.coulomb_nm
        # A falling branch steeper than what the line takes grows: in parts of 2 %. One that isn't runs to a balance,
        # which the tangent's exponential reaches in one step.
        steepest = sqrt(2.0 / e) * self._falls / friction.stribeck_speed_rad_s if self._falls else 0.0
        growth = max(0.0, steepest - self._viscous) / self._inertia * grid.tick_s
        self._parts = int(np.clip(ceil(growth / 0.02), 1, 25))
        self._part_s = grid.tick_s / self._parts
        self._tick_s = grid.tick_s

    def sliding(self, speed: Array) -> Array:
        """T_f without its sign."""
        return self._friction.coulomb_nm + self._bent(speed)

    def release(self) -> None:
        """No dry friction any more."""
        self._friction, self._falls = BitFriction(0.0, 0.0, np.inf), 0.0

    def _bent(self, speed: Array) -> Array:
        if self._falls == 0.0:
            return np.zeros_like(speed)
        over: Array = self._falls * np.exp(-((speed / self._friction.stribeck_speed_rad_s) ** 2))
        return over

    def step(self, arriving: Array, speed: Array) -> tuple[Array, Array]:
        """(wave that goes up, speed after the tick)."""
        travel = np.zeros_like(speed)
        width, inertia, part_s = self._friction.stribeck_speed_rad_s, self._inertia, self._part_s
        for _ in range(self._parts):
            side = np.where(speed != 0.0, np.sign(speed), np.sign(arriving))
            holds = (speed == 0.0) & (np.abs(arriving) <= self._friction.static_nm)
            bent = self._bent(speed)
            net = arriving - side * (self._friction.coulomb_nm + bent) - self._viscous * speed
            growth = (2.0 * bent * np.abs(speed) / width**2 - self._viscous) / inertia * part_s
            growth = np.where(np.abs(growth) < 1e-9, 1e-9, growth)
            end = speed + net / inertia * part_s * np.expm1(growth) / growth
            end = np.where(holds | (end * side < 0.0), 0.0, end)
            travel += 0.5 * (speed + end) * part_s
            speed = end
        return 2.0 * self._impedance * travel / self._tick_s - arriving, speed


# ---------------------------------------------------------------------------------------------------------------------
# Critical speeds. Always say which, and for which bit.


RPM = 2.0 * pi / 60.0
"""rad/s."""


@dataclass(frozen=True)
class CriticalSpeeds:
    """In rpm of the main shaft; None: none up to the highest that was tried, or (onset) never stuck."""

    cure_rpm: float | None
    """The lowest set speed from which a stuck bit (at breakaway, the top at full set speed) ends turning."""
    start_rpm: float | None
    """The lowest set speed at which the bit turns in the end after a ramp from rest."""
    onset_rpm: float | None
    """Set speed at which a turning bit first sticks, as it falls by 1 rpm/s."""


@dataclass(frozen=True)
class Search:
    """How critical speeds are looked for."""

    highest_rpm: float = 240.0
    lowest_rpm: float = 8.0
    coarse_rpm: float = 8.0
    resolution_rpm: float = 1.0
    duration_s: float = 100.0
    calm_s: float = 20.0
    """At the end of it: the bit turns if it has not stood still for so long."""
    start_ramp_rpm_s: float = 5.0
    onset_from_rpm: float = 210.0
    onset_fall_rpm_s: float = 1.0


def critical_speeds(string: DrillString, loops: Sequence[Loop], search: Search = Search()) -> list[CriticalSpeeds]:
    """Of every loop. Raises ValueError where no bit is stated."""
    cures = lowest_turning(string, loops, "stuck", search)
    starts = lowest_turning(string, loops, "rest", search)
    onsets = onset_speeds(string, loops, search)
    return [CriticalSpeeds(*three) for three in zip(cures, starts, onsets, strict=True)]


Start = Literal["stuck", "rest"]


def lowest_turning(string: DrillString, loops: Sequence[Loop], how: Start, search: Search) -> list[float | None]:
    """The lowest set speed, to the resolution, at which and above which every one tried ends with a bit that turns.

    First on a coarse grid, then between the last that sticks and the first above it.
    """
    coarse = np.arange(search.lowest_rpm, search.highest_rpm + 1.0, search.coarse_rpm)
    turns = _ends_turning(string, loops, how, np.tile(coarse, (len(loops), 1)), search)
    first = [_first_of_the_rest(row) for row in turns]
    parts = max(1, round(search.coarse_rpm / search.resolution_rpm))
    offsets = search.coarse_rpm * (np.arange(1, parts + 1) / parts - 1.0)
    # above a loop for which nothing turned there is nothing to look for: it goes along, and is not looked at
    top = np.array([coarse[min(at, coarse.size - 1)] for at in first])
    fine = np.maximum(top[:, None] + offsets[None, :], 0.5 * search.resolution_rpm)
    turns = _ends_turning(string, loops, how, fine, search)
    return [
        None if at == coarse.size else float(fine[k, min(_first_of_the_rest(turns[k]), parts - 1)])
        for k, at in enumerate(first)
    ]


def _first_of_the_rest(turns: NDArray[np.bool_]) -> int:
    """From which one on all are true; their number if the last is false."""
    sticking = np.flatnonzero(~turns)
    return int(sticking[-1]) + 1 if sticking.size else 0


def _ends_turning(
    string: DrillString, loops: Sequence[Loop], how: Start, speeds_rpm: Array, search: Search
) -> NDArray[np.bool_]:
    target = speeds_rpm * RPM
    begin = Begin(how, target if how == "stuck" else np.zeros_like(target))
    ramp = search.start_ramp_rpm_s * RPM
    duration = search.duration_s + (0.0 if how == "stuck" else float(target.max()) / ramp)
    trace = simulate(string, loops, begin, target, ramp, duration, keep_every_s=duration / 4.0)
    turned: NDArray[np.bool_] = trace.last_stuck_s < duration - search.calm_s
    return turned


def onset_speeds(string: DrillString, loops: Sequence[Loop], search: Search) -> list[float | None]:
    """The set speed, rpm, at which each first sticks as it falls."""
    begin = np.full((len(loops), 1), search.onset_from_rpm * RPM)
    fall = search.onset_fall_rpm_s
    duration = search.onset_from_rpm / fall
    trace = simulate(string, loops, Begin("turning", begin), np.zeros_like(begin), fall * RPM, duration,
                     keep_every_s=duration)
    stuck = trace.first_stuck_s[:, 0]
    return [float(search.onset_from_rpm - fall * time) if np.isfinite(time) else None for time in stuck]
