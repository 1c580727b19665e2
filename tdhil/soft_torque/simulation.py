r"""Simulation of top drive, string and bit in time, for many strings, controllers and set speeds at once.

The string is solved by the method of characteristics::

    a = τ + ζω travels down, b = ζω − τ travels up, each unchanged at speed c along a line

**Nodes.** Lines are divided by nodes a whole number of ticks apart. A wave is a ring buffer of past values: written at
one end, read at the other end m ticks later. There is no interpolation and no numerical dispersion. At a node the
speeds are equal, and τ_above − τ_below = βω + F sgn ω. β and F are the viscous drag and the dry friction of half of the
line above and half of the line below:

    ω = (a + b − F sgn ω)/(ζ₁ + ζ₂ + β)        a' = 2 ζ₂ ω − b        b' = 2 ζ₁ ω − a

A node at standstill stays there while |a + b| is at most its static friction. A node never adds energy: the power of
the outgoing waves is that of the arriving waves less βω² + F|ω|.

**Top.** J dω/dt = T + b − (B + ζ + β/2) ω − F_c sgn ω. Together with the states of the controller and its lags, this is
linear for a wave that is constant over a tick. Its step is a matrix exponential. The top sends down 2ζ (mean ω) − b.

**Bit.** J_L dω/dt = a − (ζ + β/2 + B_b) ω − T_f(ω) − n(t). The step is exact for the tangent of the friction curve
(exponential Rosenbrock–Euler). A tick is divided so that the speed changes little in each part. At zero speed the bit
sticks while |a − n| ≤ F_s.

**Light bit.** A bottom with less inertia than half a tick of its line, such as a bit below collars, is a line of the
same inertia. It ends in a bit without inertia, which is in balance at every moment: a − n = (ζ + β/2 + B_b) ω + T_f(ω).
Collars on falling friction oscillate at frequencies far above the string's (half a wave in 200 m: 8 Hz). A bit with
the inertia of a part of its tick would suppress this, and the critical speed would depend on the tick. If the friction
falls more steeply than the line damps, two speeds are in balance. The bit keeps to the nearest one in its direction of
acceleration: it jumps at the torques at which its branch ends.

**Bit noise.** n is a first-order Gauss–Markov process. Loops with the same seed have the same noise at every set speed.

**Many strings at once.** Each string has its own tick, and all strings have the same number of ticks. The travel times
of their lines may differ by one common factor only. All other values may differ.

No torque limit is simulated.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, e, sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from profiles.quantities import RAD_S_PER_RPM
from tdhil.soft_torque.controller import SpeedController, TopDrive
from tdhil.soft_torque.drill_string import DrillString

RPM = RAD_S_PER_RPM
"""One revolution per minute, rad/s."""
LONGEST_TICK_S = 0.006
SHORTEST_TICK_S = 0.002
DRAG_EVERY_S = 0.15
"""Approximate travel time between nodes, at which the drag is lumped. A lump reflects about β/2ζ of a wave."""
SLIDING_BLUR_RAD_S = 0.05
"""Speed over which the dry friction of the top changes from zero to its full value."""
LARGEST_GROWTH = 0.05
"""Largest relative growth of the bit's speed in one part of a tick, on a falling branch of its friction."""
LEAST_GROWTH = 1e-300
"""Value added to an exponent that is used as a divisor, so that it is never exactly zero."""
BALANCE_STEPS = 4
"""Number of Newton steps to the speed of a bit without inertia."""
NOISE_BLOCK = 500
"""Number of ticks of bit noise that are drawn at once."""

UNSTABLE_LOOPS_GROW = np.errstate(over="ignore", invalid="ignore")
"""Decorator: signals of an unstable loop grow beyond the largest number, without a warning of numpy."""

Array = NDArray[np.float64]
Loop = tuple[TopDrive, SpeedController]
Strings = DrillString | Sequence[DrillString]
"""One string for all loops, or one for each."""
Start = Literal["stuck", "rest", "turning"]


@dataclass(frozen=True)
class Grid:
    """String divided into segments of whole ticks."""

    tick_s: float
    ticks: tuple[int, ...]
    """Travel time of each segment, ticks."""
    impedance_nm_s_rad: tuple[float, ...]
    """Characteristic impedance of each segment."""
    drag_nm_s_rad: tuple[float, ...]
    """Total viscous drag of each segment."""
    coulomb_nm: tuple[float, ...]
    """Total kinetic dry friction of each segment."""
    static_nm: tuple[float, ...]
    """Total static dry friction of each segment."""
    bottom_inertia_kg_m2: float
    """Inertia of the bit. 0: a light bit, whose inertia is part of the last line."""
    line_ticks: tuple[int, ...]
    """Travel time of each line, ticks."""
    line_parts: tuple[int, ...]
    """Number of segments of each line."""

    @property
    def delay_s(self) -> float:
        """Travel time of a wave from top to bottom, s."""
        return self.tick_s * sum(self.ticks)


def _own_delay_s(string: DrillString) -> float:
    """Return the travel time, s, of a line of the last pipe that has the inertia of the bottom."""
    return string.bottom_inertia_kg_m2 / string.lines[-1].impedance_nm_s_rad


def has_light_bit(string: DrillString, longest_tick_s: float) -> bool:
    """Return whether the bottom has less inertia than half a tick of its line."""
    return _own_delay_s(string) < 0.5 * longest_tick_s


def _steepest_fall(falls: Array, width: Array) -> Array:
    """Return the steepest fall of F e^−(ω/ω_s)² over ω, N·m·s/rad: at ω = ω_s/√2."""
    return sqrt(2.0 / e) * falls / width


def bit_jumps(string: DrillString, longest_tick_s: float) -> bool:
    """Return whether a light bit's friction falls more steeply than its line damps: it jumps from speed to speed."""
    damps, bit = string.lines[-1].impedance_nm_s_rad + string.bottom_viscous_nm_s_rad, string.bit
    if bit is None or not has_light_bit(string, longest_tick_s):
        return False
    falls = np.array(bit.static_nm - bit.coulomb_nm)
    return bool(_steepest_fall(falls, np.array(bit.stribeck_speed_rad_s)) > damps)


def grid_of(string: DrillString, longest_tick_s: float = LONGEST_TICK_S) -> Grid:
    """Return the grid with the tick for which rounding changes the travel times of all lines least."""
    delays = np.array([line.delay_s for line in string.lines])
    light = has_light_bit(string, longest_tick_s)
    if light:
        delays[-1] += _own_delay_s(string)

    def rounded(tick: float) -> tuple[NDArray[np.int64], float]:
        counts = np.maximum(1, np.rint(delays / tick)).astype(np.int64)
        return counts, float(np.abs(counts * tick - delays).sum())

    if len(delays) == 1:
        exact = float(delays[0]) / ceil(float(delays[0]) / longest_tick_s * (1.0 - 1e-9))
        candidates = np.full(1, exact)
    else:
        shortest = min(SHORTEST_TICK_S * longest_tick_s / LONGEST_TICK_S, longest_tick_s)
        candidates = np.linspace(shortest, longest_tick_s, 400)
    tick = float(min(candidates, key=lambda one: rounded(float(one))[1] / one**0.25))
    counts = tuple(int(count) for count in rounded(tick)[0])
    parts = tuple(
        max(1, min(count, round(line.delay_s / DRAG_EVERY_S))) if line.has_friction else 1
        for line, count in zip(string.lines, counts, strict=True)
    )
    return _cut(string, tick, counts, parts, light)


def grid_like(string: DrillString, model: DrillString, grid: Grid) -> Grid:
    """Return the grid of ``string``, with the same numbers of ticks and segments as ``grid``, the grid of ``model``.

    Raises ValueError if the travel times of the lines differ by more than one common factor.
    """
    factors = [line.delay_s / other.delay_s for line, other in zip(string.lines, model.lines, strict=True)]
    if max(factors) > 1.001 * min(factors):
        raise ValueError("the travel times of the lines differ by more than one common factor")
    return _cut(string, grid.tick_s * factors[0], grid.line_ticks, grid.line_parts, grid.bottom_inertia_kg_m2 == 0.0)


def _cut(string: DrillString, tick_s: float, counts: tuple[int, ...], parts: tuple[int, ...], light: bool) -> Grid:
    ticks: list[int] = []
    of_segments: list[tuple[float, float, float, float]] = []
    inertia, last = string.bottom_inertia_kg_m2, string.lines[-1]
    impedances = [line.impedance_nm_s_rad for line in string.lines]
    if light:      # the last line has its own inertia and the bit's, even if its travel time is rounded
        impedances[-1] = (last.length_m * last.inertia_kg_m + inertia) / (counts[-1] * tick_s)
        inertia = 0.0
    for line, impedance, count, part in zip(string.lines, impedances, counts, parts, strict=True):
        edges = np.rint(np.linspace(0, count, part + 1)).astype(int)
        for size in np.diff(edges):
            share_m = line.length_m * float(size) / float(count)
            ticks.append(int(size))
            of_segments.append((impedance, line.drag_nm_s_rad_m * share_m,
                                line.coulomb_nm_m * share_m, line.static_nm_m * share_m))
    along, drags, kinetic, static = zip(*of_segments, strict=True)
    return Grid(tick_s, tuple(ticks), along, drags, kinetic, static, inertia, counts, parts)


@dataclass(frozen=True)
class SimulationTrace:
    """Stored signals. The first index is the time, the second the loop, the third the set speed."""

    time_s: Array
    """Time of the first loop. The time of another loop differs by the ratio of the strings' travel times."""
    set_rad_s: Array
    top_rad_s: Array
    bit_rad_s: Array
    top_torque_nm: Array
    """Torque of the drive on the rotor."""
    last_stuck_s: Array
    """Time of the bit's last standstill, (loops, speeds). −1: never."""


@dataclass(frozen=True)
class Begin:
    """Initial state of a simulation.

    ``stuck``: the bit is about to break away. The string is twisted by the breakaway torque and stands still. The top
    turns at full speed, and its integral balances the string. ``rest``: everything stands still, without torque.
    ``turning``: everything turns steadily at one speed. Loops that turn are not simulated together with others.
    """

    how: Start | Sequence[Start]
    """One for all loops, or one for each."""
    speed_rad_s: Array
    """Initial speed of the top, (loops, speeds)."""


@dataclass(frozen=True)
class TopDisturbance:
    """Torque that accelerates the rotor besides drive and string, N·m: (loops, samples), held for ``every_s`` each.

    The record repeats after its last sample.
    """

    torque_nm: Array
    every_s: float

    def at(self, time_s: float) -> Array:
        """Return the torque of every loop at that time, (loops, 1)."""
        found: Array = self.torque_nm[:, int(time_s / self.every_s) % self.torque_nm.shape[1], None]
        return found


class LoopSimulation:
    """Simulation of every loop at every set speed, tick by tick.

    After ``hold_s``, the set speed ramps from its value in ``begin`` to ``target_rad_s``, shape (loops, speeds).
    ``disturbance``: seeds of the bit noise, one for each loop, or torque on the rotors; None: neither. All times are
    for the first string. Raises ValueError if a bit is not stated.
    """

    def __init__(
        self, strings: Strings, loops: Sequence[Loop], begin: Begin, target_rad_s: Array, ramp_rad_s2: float,
        longest_tick_s: float = LONGEST_TICK_S, hold_s: float = 0.0,
        disturbance: Sequence[int] | TopDisturbance | None = None,
    ) -> None:
        every_string = [strings] * len(loops) if isinstance(strings, DrillString) else list(strings)
        first_string = every_string[0]
        self.grid = grid_of(first_string, longest_tick_s)
        known = {first_string: self.grid}
        for one in every_string:
            if one not in known:
                known[one] = grid_like(one, first_string, self.grid)
        grids = [known[one] for one in every_string]
        shape = target_rad_s.shape
        self.top = _Top(loops, grids, shape[1])
        self._pipe = PipeSimulation(every_string, grids, shape[1])
        how = np.array([begin.how] * len(loops) if isinstance(begin.how, str) else begin.how)[:, None]
        speed = np.where(how == "rest", 0.0, np.broadcast_to(begin.speed_rad_s, shape))
        if np.any(how == "turning"):
            held = self._pipe.turn(speed.ravel()).reshape(shape)
        else:
            held = np.where(how == "stuck", self._pipe.breakaway_nm.reshape(shape), 0.0)
            self._pipe.wind_up(held.ravel())
        self.top.begin(speed, held)
        self._torque = disturbance if isinstance(disturbance, TopDisturbance) else None
        self._noise = None
        if disturbance is not None and not isinstance(disturbance, TopDisturbance):
            self._noise = _BitNoise(every_string, grids, disturbance, shape[1])
        self.tick_s = np.array([one.tick_s for one in grids])[:, None]
        self.set_rad_s, self._target_rad_s = speed, target_rad_s
        self._ramp = ramp_rad_s2 * self.tick_s
        self._arrived, self._held_ticks = False, round(hold_s / self.grid.tick_s)
        self.ticks = 0
        """Number of ticks that are simulated."""

    @property
    def bit_rad_s(self) -> Array:
        """Return the speed of every bit, (loops, speeds)."""
        return self._pipe.bit_rad_s.reshape(self.set_rad_s.shape)

    def advance(self) -> Array:
        """Advance by one tick. Return the mean speed of every top over the tick."""
        top_wave, mean_top = self._advance_top(self._pipe.at_top())
        self._pipe.tick(top_wave, None if self._noise is None else self._noise.at(self.ticks - 1))
        return mean_top

    def advance_together(self, most: int) -> Array:
        """Advance by up to ``most`` ticks: those in which no wave crosses a segment, so that all waves are known.

        Return the speed of every bit after each tick, (ticks, loops, speeds).
        """
        waves = self._pipe.coming_to_top(most)
        noise = None if self._noise is None else np.array([self._noise.at(self.ticks + k) for k in range(len(waves))])
        bits = self._pipe.tick_together(np.array([self._advance_top(wave)[0] for wave in waves]), noise)
        return bits.reshape(-1, *self.set_rad_s.shape)

    def _advance_top(self, wave: Array) -> tuple[Array, Array]:
        """Advance every top by one tick. Return (waves that go down, mean speeds)."""
        if self.ticks >= self._held_ticks and not self._arrived:
            self.set_rad_s = self.set_rad_s + np.clip(self._target_rad_s - self.set_rad_s, -self._ramp, self._ramp)
            self._arrived = bool(np.array_equal(self.set_rad_s, self._target_rad_s))
        other_nm = 0.0 if self._torque is None else self._torque.at(self.ticks * self.grid.tick_s)
        self.ticks += 1
        return self.top.step(wave, self.set_rad_s, other_nm)

    def keep(self, loops: NDArray[np.bool_]) -> None:
        """Go on with these loops only. Not for a torque on the rotors."""
        cases = np.repeat(loops, self.set_rad_s.shape[1])
        self.top.keep(loops)
        self._pipe.keep(cases)
        if self._noise is not None:
            self._noise.keep(cases)
        self.tick_s, self._ramp = self.tick_s[loops], self._ramp[loops]
        self.set_rad_s, self._target_rad_s = self.set_rad_s[loops], self._target_rad_s[loops]


@UNSTABLE_LOOPS_GROW
def simulate(
    strings: Strings,
    loops: Sequence[Loop],
    begin: Begin,
    target_rad_s: Array,
    ramp_rad_s2: float,
    duration_s: float,
    keep_every_s: float = 0.1,
    longest_tick_s: float = LONGEST_TICK_S,
    hold_s: float = 0.0,
    disturbance: Sequence[int] | TopDisturbance | None = None,
) -> SimulationTrace:
    """Simulate every loop at every set speed, and return the stored signals: see `LoopSimulation`.

    Raises ValueError if a bit is not stated.
    """
    running = LoopSimulation(strings, loops, begin, target_rad_s, ramp_rad_s2, longest_tick_s, hold_s, disturbance)
    tick_s = running.grid.tick_s
    every = max(1, round(keep_every_s / tick_s))
    kept: list[tuple[float, Array, Array, Array, Array]] = []
    last: Array = np.full(target_rad_s.shape, -1.0)
    for tick in range(ceil(duration_s / tick_s)):
        mean_top = running.advance()
        np.putmask(last, running.bit_rad_s == 0.0, tick + 1.0)
        if tick % every == 0:
            kept.append(((tick + 1) * tick_s, running.set_rad_s, mean_top, running.bit_rad_s, running.top.torque_nm))
    times, sets, tops, bits, torques = zip(*kept, strict=True)
    return SimulationTrace(np.array(times), np.array(sets), np.array(tops), np.array(bits), np.array(torques),
                           np.where(last < 0.0, last, last * running.tick_s))


class _BitNoise:
    """Bit noise n(t) of every case, drawn for each seed, with the rms and the correlation time of each string's bit."""

    def __init__(self, strings: Sequence[DrillString], grids: Sequence[Grid], seeds: Sequence[int], repeats: int
                 ) -> None:
        bits = [one.bit for one in strings]
        rms = [0.0 if bit is None else bit.noise_nm for bit in bits]
        keep = [float(np.exp(-grid.tick_s / max(1e-9, 1.0 if bit is None else bit.noise_correlation_s)))
                for bit, grid in zip(bits, grids, strict=True)]
        # loops with the same seed, rms and correlation have the same noise: it is computed once
        of_loops = list(zip(seeds, rms, keep, strict=True))
        noises, different_seeds = list(dict.fromkeys(of_loops)), list(dict.fromkeys(seeds))
        self._random = [np.random.default_rng(seed) for seed in different_seeds]
        self._seed_at = np.array([different_seeds.index(seed) for seed, _, _ in noises])
        self._rms, self._keep = np.array([one[1:] for one in noises]).T
        self._new = np.sqrt(1.0 - self._keep**2)
        self._noise_at = np.repeat([noises.index(noise) for noise in of_loops], repeats)
        self._state = np.array([random.standard_normal() for random in self._random])[self._seed_at]
        self._torque_nm: Array = np.empty((0, len(noises)))

    def at(self, tick: int) -> Array:
        """Return the noise torque during a tick, N·m. Call it for every tick in order."""
        row = tick % NOISE_BLOCK
        if row == 0:
            drawn = np.array([random.standard_normal(NOISE_BLOCK) for random in self._random]).T
            block = self._new * drawn[:, self._seed_at]
            for place in range(NOISE_BLOCK):
                block[place] += self._keep * self._state
                self._state = block[place]
            self._torque_nm = self._rms * block
        found: Array = self._torque_nm[row].take(self._noise_at)
        return found

    def keep(self, cases: NDArray[np.bool_]) -> None:
        """Go on with these cases only."""
        self._noise_at = self._noise_at[cases]


def _columns(values: Sequence[Sequence[float]], repeats: int) -> Array:
    """Return an array (segments, cases) from one row for each string."""
    return np.repeat(np.array(values, dtype=float).T, repeats, axis=1)


class _Waves:
    """Ring buffers of the waves in all segments. A wave enters at one end and leaves at the other after its ticks.

    A buffer has one row for each tick: first the waves that went down into each segment, then those that went up.
    """

    def __init__(self, grids: Sequence[Grid], repeats: int) -> None:
        cases = len(grids) * repeats
        ticks = np.array(grids[0].ticks)
        self._shortest = int(ticks.min())
        self._size = ceil(ticks.max() / self._shortest) * self._shortest
        self._count = count = len(ticks)
        self._sent = np.zeros((self._size, 2 * count, cases))
        # index, over all rows together, of the waves that arrive now
        slots = (np.arange(self._size)[:, None] - np.tile(ticks, 2)) % self._size
        self._arriving_at = slots * (2 * count) + np.arange(2 * count)
        self._every = self._sent.reshape(-1, cases)
        self._now = 0
        self._impedance = _columns([grid.impedance_nm_s_rad for grid in grids], repeats)
        self._drag = _columns([grid.drag_nm_s_rad for grid in grids], repeats)
        self._coulomb = _columns([grid.coulomb_nm for grid in grids], repeats)
        static = _columns([grid.static_nm for grid in grids], repeats)
        above, below = self._impedance[:-1], self._impedance[1:]
        beta = 0.5 * (self._drag[:-1] + self._drag[1:])
        self._over = 1.0 / (above + below + beta)
        self._twice_above, self._twice_below = 2.0 * above, 2.0 * below
        self._kinetic = 0.5 * (self._coulomb[:-1] + self._coulomb[1:])
        self._static = np.maximum(0.5 * (static[:-1] + static[1:]), self._kinetic)
        self._dry = bool(np.any(self._static > 0.0))
        self._moving = np.zeros(self._kinetic.shape, dtype=bool)

    def fill(self, bottom_torque_nm: Array, speed: Array) -> None:
        """Set one speed along the whole string. The torque grows upwards because of drag and friction."""
        torque = bottom_torque_nm.copy()
        side = np.sign(speed)
        below: Array = np.zeros_like(torque)
        self._moving[:] = speed != 0.0
        for row in range(self._count - 1, -1, -1):
            own, impedance = self._drag[row] * speed + self._coulomb[row] * side, self._impedance[row]
            torque = torque + 0.5 * (own + below)
            below = own
            self._sent[:, row] = torque + impedance * speed
            self._sent[:, self._count + row] = impedance * speed - torque

    def keep(self, cases: NDArray[np.bool_]) -> None:
        """Go on with these cases only."""
        (self._sent, self._impedance, self._drag, self._coulomb, self._over, self._twice_above, self._twice_below,
         self._kinetic, self._static, self._moving) = (one.compress(cases, axis=-1) for one in (
            self._sent, self._impedance, self._drag, self._coulomb, self._over, self._twice_above, self._twice_below,
            self._kinetic, self._static, self._moving))
        self._every = self._sent.reshape(-1, self._sent.shape[-1])

    def top_torque(self, top_speed: Array) -> Array:
        """Return the string's torque τ just below the rotor, N·m."""
        felt = self._impedance[0] + 0.5 * self._drag[0]
        torque: Array = felt * top_speed + 0.5 * self._coulomb[0] * np.sign(top_speed) - self.at_top()
        return torque

    def at_top(self) -> Array:
        """Return the wave that leaves the topmost segment at its upper end now."""
        arriving: Array = self._every[self._arriving_at[self._now, self._count]]
        return arriving

    def coming_to_top(self, most: int) -> Array:
        """Return the waves that leave the topmost segment at its upper end in the next ticks.

        They are at most as many as the shortest segment has, and as the buffers have up to their end.
        """
        ticks = min(most, self._shortest, self._size - self._now)
        coming: Array = self._every[self._arriving_at[self._now : self._now + ticks, self._count]]
        return coming

    def arriving(self, ticks: int) -> tuple[Array, Array]:
        """Return the waves that leave every segment in each of the next ticks: at the lower ends, at the upper ends."""
        arriving = self._every.take(self._arriving_at[self._now : self._now + ticks], axis=0)
        return arriving[:, : self._count], arriving[:, self._count :]

    def send(self, down: Array, up: Array, from_top: Array, from_bit: Array) -> None:
        """Pass the waves of one or more ticks through every node, and advance by these ticks."""
        a, b = down[:, :-1], up[:, 1:]
        driven = a + b
        if self._dry:
            moving, size = np.empty(driven.shape, dtype=bool), np.abs(driven)
            for tick, own in enumerate(size):
                self._moving = np.greater(own, np.where(self._moving, self._kinetic, self._static), out=moving[tick])
            driven -= np.copysign(self._kinetic, driven, out=size)
            np.putmask(driven, ~moving, 0.0)
        speed = np.multiply(driven, self._over, out=driven)
        sent = self._sent[self._now : self._now + len(driven)]
        sent[:, 0], sent[:, -1] = from_top, from_bit
        down, up = sent[:, 1 : self._count], sent[:, self._count : -1]
        np.subtract(np.multiply(self._twice_below, speed, out=down), b, out=down)
        np.subtract(np.multiply(self._twice_above, speed, out=up), a, out=up)
        self._now = (self._now + len(driven)) % self._size


class PipeSimulation:
    """Simulation of string and bit below a top drive, simulated or real, tick by tick. Arrays have one value a case."""

    def __init__(self, strings: Sequence[DrillString], grids: Sequence[Grid], repeats: int = 1) -> None:
        self._waves = _Waves(grids, repeats)
        light = grids[0].bottom_inertia_kg_m2 == 0.0
        self._bit = _LightBit(strings, grids, repeats) if light else _HeavyBit(strings, grids, repeats)
        self._viscous = np.repeat([string.bottom_viscous_nm_s_rad for string in strings], repeats)
        self.bit_rad_s: Array = np.zeros(len(strings) * repeats)

    @property
    def breakaway_nm(self) -> Array:
        """Return the torque at which each bit begins to turn."""
        return self._bit.static_nm

    def wind_up(self, torque_nm: Array) -> None:
        """Set the string to standstill, twisted by that torque."""
        self._waves.fill(torque_nm, np.zeros(torque_nm.size))

    def turn(self, speed: Array) -> Array:
        """Set string and bit to steady rotation at that speed, rad/s. Return the torque at the top, N·m."""
        self.bit_rad_s = speed.copy()
        load = self._bit.rubbing(speed) * np.sign(speed) + self._viscous * speed
        self._waves.fill(load, speed)
        return self.top_torque(speed)

    def keep(self, cases: NDArray[np.bool_]) -> None:
        """Go on with these cases only."""
        self._waves.keep(cases)
        self._bit.keep(cases)
        self._viscous, self.bit_rad_s = self._viscous[cases], self.bit_rad_s[cases]

    def release(self) -> None:
        """Remove the dry friction of the bit, as when it is lifted off bottom."""
        self._bit.release()

    def at_top(self) -> Array:
        """Return the wave b that leaves the topmost segment upwards during the coming tick."""
        return self._waves.at_top()

    def top_torque(self, speed: Array) -> Array:
        """Return the string's torque τ just below the rotor at that speed, N·m."""
        return self._waves.top_torque(speed)

    def coming_to_top(self, most: int) -> Array:
        """Return the waves b of the next ticks, (ticks, cases): of those for which all waves are known."""
        return self._waves.coming_to_top(most)

    def tick(self, from_top: Array, noise_nm: Array | None = None) -> None:
        """Advance by one tick, with the wave that the top sends down during it."""
        self.tick_together(from_top[None], None if noise_nm is None else noise_nm[None])

    def tick_together(self, from_top: Array, noise_nm: Array | None = None) -> Array:
        """Advance by some ticks, at most those of the shortest segment. Return each bit's speed after each tick.

        All arrays are (ticks, cases).
        """
        arriving_down, arriving_up = self._waves.arriving(len(from_top))
        bit_waves, bits = self._bit.steps(arriving_down[:, -1], self.bit_rad_s, noise_nm)
        self._waves.send(arriving_down, arriving_up, from_top, bit_waves)
        self.bit_rad_s = bits[-1]
        return bits


class _Top:
    """Rotor, controller and lags of every loop at every set speed."""

    def __init__(self, loops: Sequence[Loop], grids: Sequence[Grid], speeds: int) -> None:
        self._lags = max(1, *(len(drive.inner_lags_s) for drive, _ in loops))
        self._size = size = 4 + self._lags
        ticks = np.array([grid.tick_s for grid in grids])
        self._impedance = np.array([grid.impedance_nm_s_rad[0] for grid in grids])[:, None]
        # matrices that map (states + inputs) to states
        step = np.array([_top_step(*loop, grid, self._lags)[:size] for loop, grid in zip(loops, grids, strict=True)])
        step[:, 3] /= ticks[:, None]         # the state ∫ω dt becomes the mean speed over the tick
        step[:, :, 3] = 0.0                  # the integral starts again from zero in each tick
        self._step = np.ascontiguousarray(step)
        self._dry = np.array([drive.coulomb_nm + 0.5 * grid.coulomb_nm[0]
                              for (drive, _), grid in zip(loops, grids, strict=True)])[:, None]
        self._own_dry = np.array([drive.coulomb_nm for drive, _ in loops])[:, None]
        self._viscous = np.array([drive.viscous_nm_s_rad for drive, _ in loops])[:, None]
        self._state = np.zeros((len(loops), size + 3, speeds))
        """States, then the inputs of the tick (wave, dry friction, set speed); (loops, states + inputs, speeds)."""

    @property
    def torque_nm(self) -> Array:
        """Torque of the drive on the rotor, N·m."""
        torque: Array = self._state[:, 3 + self._lags].copy()
        return torque

    def keep(self, loops: NDArray[np.bool_]) -> None:
        """Go on with these loops only."""
        self._step, self._state, self._impedance, self._dry, self._own_dry, self._viscous = (
            one[loops] for one in (self._step, self._state, self._impedance, self._dry, self._own_dry, self._viscous))

    def begin(self, speed: Array, string_torque_nm: Array) -> None:
        """Set the top to steady rotation at the set speed. The drive's torque balances the string's."""
        torque = string_torque_nm + self._viscous * speed + self._own_dry * np.clip(
            speed / SLIDING_BLUR_RAD_S, -1.0, 1.0)
        self._state[:, 0] = self._state[:, 2] = speed
        self._state[:, 1] = torque
        self._state[:, 4 : self._size] = torque[:, None, :]

    def step(self, arriving: Array, set_speed: Array, other_nm: Array | float = 0.0) -> tuple[Array, Array]:
        """Advance by one tick, with a further torque on the rotor.

        Return (wave that goes down, mean speed of the top over the tick).
        """
        state, size = self._state, self._size
        wave = arriving.reshape(set_speed.shape)
        state[:, size] = wave
        dry = -self._dry * np.minimum(np.maximum(state[:, 0] / SLIDING_BLUR_RAD_S, -1.0), 1.0)
        state[:, size + 1] = dry + other_nm
        state[:, size + 2] = set_speed
        after = self._step @ state
        state[:, :size] = after
        mean: Array = after[:, 3]
        return (2.0 * self._impedance * mean - wave).ravel(), mean


@lru_cache(maxsize=2048)
def _top_step(drive: TopDrive, controller: SpeedController, grid: Grid, most_lags: int) -> Array:
    """Return the transition matrix of one tick.

    States: ω, I ∫e dt, filtered ω, ∫ω dt, lags. Inputs: wave, dry friction with other torques, set speed.
    """
    from scipy.linalg import expm

    size = 4 + most_lags
    law = np.zeros((size + 3, size + 3))
    wave, dry, wanted = size, size + 1, size + 2
    lags = [lag for lag in drive.inner_lags_s if lag > 0.0]
    lags += [1e-4] * (most_lags - len(lags))
    inertia = drive.inertia_kg_m2
    felt = grid.impedance_nm_s_rad[0] + 0.5 * grid.drag_nm_s_rad[0]
    law[0, 0] = -(drive.viscous_nm_s_rad + felt) / inertia
    law[0, 3 + most_lags] = law[0, wave] = law[0, dry] = 1.0 / inertia
    law[1, 0], law[1, wanted] = -controller.integral_nm_rad, controller.integral_nm_rad
    filter_s = controller.derivative_filter_s
    law[2, 0], law[2, 2] = 1.0 / filter_s, -1.0 / filter_s
    law[3, 0] = 1.0
    back = controller.compensated_kg_m2 / filter_s
    law[4, 0], law[4, wanted] = back - controller.gain_nm_s_rad, controller.gain_nm_s_rad
    law[4, 1], law[4, 2] = 1.0, -back
    law[4] /= lags[0]
    law[4, 4] -= 1.0 / lags[0]
    for number, lag in enumerate(lags[1:], start=5):
        law[number, number - 1], law[number, number] = 1.0 / lag, -1.0 / lag
    found: Array = expm(law * grid.tick_s)
    return found


class _Bit(ABC):
    """Friction of the bit and of the lower end of the string. Arrays have one value for each case."""

    def __init__(self, strings: Sequence[DrillString], grids: Sequence[Grid], repeats: int) -> None:
        def each(values: Sequence[float]) -> Array:
            return np.repeat(np.array(values, dtype=float), repeats)

        bits = [string.bit for string in strings]
        if any(bit is None for bit in bits):
            raise ValueError("no bit is stated")
        along = [0.5 * grid.coulomb_nm[-1] for grid in grids]
        along_static = [0.5 * grid.static_nm[-1] for grid in grids]
        self._wall = each(along)
        self._coulomb = each([bit.coulomb_nm + more for bit, more in zip(bits, along, strict=True) if bit])
        self.static_nm = each([bit.static_nm + more for bit, more in zip(bits, along_static, strict=True) if bit])
        self._falls = each([bit.static_nm - bit.coulomb_nm for bit in bits if bit])
        self._width = each([bit.stribeck_speed_rad_s for bit in bits if bit])
        self._impedance = each([grid.impedance_nm_s_rad[-1] for grid in grids])
        self._viscous = self._impedance + each([
            string.bottom_viscous_nm_s_rad + 0.5 * grid.drag_nm_s_rad[-1]
            for string, grid in zip(strings, grids, strict=True)])
        self._bends = bool(np.any(self._falls > 0.0))
        self._curve = -1.0 / self._width**2
        self._rests_harder = any(more > own for more, own in zip(along_static, along, strict=True))

    def rubbing(self, speed: Array) -> Array:
        """Return the magnitude of the friction torque T_f of the bit alone, N·m."""
        return self._coulomb - self._wall + self._bent(speed)

    def keep(self, cases: NDArray[np.bool_]) -> None:
        """Go on with these cases only."""
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(self, name, value[cases])

    def release(self) -> None:
        """Remove the dry friction of the bit."""
        self._coulomb, self._falls = self._wall.copy(), np.zeros_like(self._falls)
        self.static_nm, self._bends, self._rests_harder = self._wall.copy(), False, False

    @abstractmethod
    def step(self, arriving: Array, speed: Array, noise_nm: Array | None = None) -> tuple[Array, Array]:
        """Advance by one tick. Return (wave that goes up, speed after the tick)."""

    def steps(self, arriving: Array, speed: Array, noise_nm: Array | None = None) -> tuple[Array, Array]:
        """Advance by some ticks. Return (waves that go up, speeds), as (ticks, cases)."""
        waves, speeds = np.empty((2, *arriving.shape))
        for tick, wave in enumerate(arriving):
            waves[tick], speed = self.step(wave, speed, None if noise_nm is None else noise_nm[tick])
            speeds[tick] = speed
        return waves, speeds

    def _bent(self, speed: Array) -> Array:
        if not self._bends:
            return np.zeros_like(speed)
        over: Array = speed * speed
        over *= self._curve
        np.exp(over, out=over)
        over *= self._falls
        return over


class _HeavyBit(_Bit):
    """Bit with inertia."""

    def __init__(self, strings: Sequence[DrillString], grids: Sequence[Grid], repeats: int) -> None:
        super().__init__(strings, grids, repeats)
        inertia = np.repeat([grid.bottom_inertia_kg_m2 for grid in grids], repeats)
        tick_s = np.repeat([grid.tick_s for grid in grids], repeats)
        # If the friction falls more steeply than the line damps, the speed grows: by at most 5 % in one part of a tick.
        # If not, the speed tends to an equilibrium, which the exponential of the tangent reaches in one step.
        steepest = _steepest_fall(self._falls, self._width)
        growth = float(np.max(np.maximum(0.0, steepest - self._viscous) / inertia * tick_s))
        self._parts = int(np.clip(ceil(growth / LARGEST_GROWTH), 1, 25))
        part_s = tick_s / self._parts
        self._pace = part_s / inertia
        self._slower = np.minimum(-self._viscous * self._pace, -1e-9)
        self._steeper = 2.0 * self._pace / self._width**2
        self._twice_over_parts = self._impedance / self._parts

    def step(self, arriving: Array, speed: Array, noise_nm: Array | None = None) -> tuple[Array, Array]:
        """Advance by one tick. Return (wave that goes up, speed after the tick)."""
        driven = arriving if noise_nm is None else arriving - noise_nm
        travel = speed
        for part in range(self._parts):
            toward = np.where(speed != 0.0, speed, driven)      # has the sign of the motion
            bent = self._bent(speed)
            net = driven - np.copysign(self._coulomb + bent, toward) - self._viscous * speed
            growth = self._slower
            if self._bends:
                growth = growth + bent * np.abs(speed) * self._steeper
                growth += LEAST_GROWTH
            end = speed + net * self._pace * np.expm1(growth) / growth
            # A reversal means that friction drives the bit back. So the bit stops, or does not break away.
            stops = end * toward < 0.0
            if self._rests_harder:
                stops |= (speed == 0.0) & (np.abs(driven) <= self.static_nm)
            np.putmask(end, stops, 0.0)
            travel = travel + end if part == self._parts - 1 else travel + 2.0 * end
            speed = end
        return travel * self._twice_over_parts - arriving, speed


class _LightBit(_Bit):
    """Bit without inertia, in balance at every moment.

    The balance torque V ω + F_c + (F_s − F_c) e^−(ω/ω_s)² rises up to a speed ω₁, falls if the friction falls more
    steeply than V, and rises again from a speed ω₂. It is concave below ω₁ and convex above ω₂. So Newton's method
    converges from one side: from the tangent at zero speed below, and from the asymptote above.
    """

    def __init__(self, strings: Sequence[DrillString], grids: Sequence[Grid], repeats: int) -> None:
        from scipy.special import lambertw

        super().__init__(strings, grids, repeats)
        self._steeper = -2.0 * self._curve
        # The slope is zero where u e^−u² = V ω_s/2(F_s − F_c), u = ω/ω_s. If it is nowhere zero, both ends of the
        # branches are at the steepest point, u² = 1/2.
        falling = np.maximum(self._falls, LEAST_GROWTH)
        least = np.minimum(0.5 * (self._viscous * self._width / falling) ** 2, (1.0 - 1e-9) / e)
        ends = []
        for branch in (0, -1):
            end = np.sqrt(np.maximum(-0.5 * np.real(lambertw(-least, branch)), 0.0))
            end = np.where(self._falls > 0.0, end, 0.0) * np.where(self._falls > 0.0, self._width, 1.0)
            ends.append(self._viscous * end + self._coulomb + self._bent(end))
        self._slow_below, self._fast_above = ends
        self._surely_fast, self._surely_slow = np.maximum(*ends), np.minimum(*ends)
        self._flattest = 1e-3 * self._viscous
        self._steepest_at = self._width / sqrt(2.0)

    def step(self, arriving: Array, speed: Array, noise_nm: Array | None = None) -> tuple[Array, Array]:
        """Advance by one tick. Return (wave that goes up, speed in this tick)."""
        driven = arriving if noise_nm is None else arriving - noise_nm
        was_fast = speed * np.sign(driven) > self._steepest_at
        end = self._balanced(driven, np.abs(driven) > np.where(was_fast, self._fast_above, self._slow_below))
        if self._rests_harder:
            end = np.where((speed * driven <= 0.0) & (np.abs(driven) <= self.static_nm), 0.0, end)
        return 2.0 * self._impedance * end - arriving, end

    def steps(self, arriving: Array, speed: Array, noise_nm: Array | None = None) -> tuple[Array, Array]:
        """Advance by some ticks: at once, unless the balance depends on the speed in the tick before."""
        driven = arriving if noise_nm is None else arriving - noise_nm
        torque = np.abs(driven)
        fast = torque > self._surely_fast
        if self._rests_harder or (self._bends and np.any(~fast & (torque > self._surely_slow))):
            return super().steps(arriving, speed, noise_nm)
        end = self._balanced(driven, fast)
        return 2.0 * self._impedance * end - arriving, end

    def _balanced(self, driven: Array, fast: NDArray[np.bool_]) -> Array:
        """Return the speed in balance. ``fast``: on the fast branch."""
        torque = np.abs(driven)
        rests = torque <= self._coulomb + self._falls
        found = (torque - self._coulomb) / self._viscous
        if self._bends:
            rests &= ~fast
            found -= np.where(fast, 0.0, self._falls / self._viscous)
            for _ in range(BALANCE_STEPS):
                bent = self._bent(found)
                over = self._viscous * found + self._coulomb + bent - torque
                found = found - over / np.maximum(self._viscous - self._steeper * found * bent, self._flattest)
        return np.where(rests, 0.0, np.copysign(found, driven))
