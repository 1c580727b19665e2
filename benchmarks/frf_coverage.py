"""Frequency response: coverage of each line's interval, and how often distortion is flagged.

    python benchmarks/frf_coverage.py [--plants 200] [--kinds rigid,two-mass,string,zero,stribeck] [--first 1]

Linear plants (rigid, two-mass, string) have random inertias, friction, springs, lags and noise. The truth at each line
is the plant as the drive reports it: scipy.signal gives the response of the discrete equations that the test benches
step, lag filters included. The string's is the telegraph equation, held over a step. None of it is the estimator's.

Two kinds are not linear: dry friction at a speed that changes its sign (zero), and the Stribeck effect at the speeds of
the motion. Printed for each kind: covered intervals of |ω/T|, its phase, |T/ω| and apparent inertia, of all lines and
of each position of a line (the first, the second …) over the plants, and recordings with distortion flagged. A line of
progress follows each ten plants.

Required, by observed shares: each of the four intervals of linear plants covers in at least 93 % of all lines; linear
plants are flagged in at most 2 %, others in at least 95 %; each recording has a response. The exit code is 1 otherwise.
Lines of one plant are not independent, and a position has as many lines as plants: it fails if less than 93 % are
covered beyond what chance allows (one-sided 99 %, Clopper and Pearson); positions with a share below 93 % are listed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from scipy import signal

from benchmarks.shares import met
from tdhil.estimation import FrequencyResponse, identify
from tdhil.recording.recording import Recording
from tdhil.runner.excitation import RigGuess
from tests.estimation import compliant_bench, shaft_bench
from tests.estimation.planned_motions import planned

LEAST_COVERED, MOST_FLAGGED, LEAST_FLAGGED = 0.93, 0.02, 0.95       # of lines, linear plants, others; issue 29
PARTS = ("|ω/T|", "phase", "|T/ω|", "apparent inertia")
PROGRESS = 10           # plants between two lines of progress
LINEAR = ("rigid", "two-mass", "string")
Truth = Callable[[float], complex]      # ω/T as reported, over hertz


def lag_filter(tau_s: float, step_s: float) -> tuple[list[float], list[float]]:
    """Return the filter that the benches apply: exact for an input that is straight between steps."""
    if tau_s <= 0.0:
        return [1.0], [1.0]
    keep = math.exp(-step_s / tau_s)
    return [1.0 - (1.0 - keep) * tau_s / step_s, (1.0 - keep) * tau_s / step_s - keep], [1.0, -keep]


def lags(hertz: float, step_s: float, speed_s: float, torque_s: float) -> complex:
    """Return the response of the reported speed's filter over that of the torque's."""
    turn = [2.0 * math.pi * hertz * step_s]
    (_, of_speed), (_, of_torque) = (signal.freqz(*lag_filter(tau, step_s), worN=turn) for tau in (speed_s, torque_s))
    return complex(of_speed[0] / of_torque[0])


def rigid(seed: int, **more: float) -> tuple[shaft_bench.Rig, np.random.Generator]:
    rng = np.random.default_rng([seed, 11])
    noise = 2.0 ** rng.uniform(-1.0, 1.0)
    usual = shaft_bench.Rig()
    return replace(
        usual,
        inertia=104.0 * rng.uniform(0.7, 1.4), viscous=rng.uniform(3.0, 16.0), coulomb=rng.uniform(30.0, 80.0),
        speed_poles=(rng.uniform(0.0, 0.5),), torque_poles=(rng.uniform(0.0, 0.3),),
        load_sd=noise * usual.load_sd, ripple_sd=noise * usual.ripple_sd, sensor_sd=noise * usual.sensor_sd, **more,
    ), rng


def rigid_truth(rig: shaft_bench.Rig) -> Truth:
    step = shaft_bench.DT
    plant = signal.dlti([step / rig.inertia], [1.0, step * rig.viscous / rig.inertia - 1.0], dt=step)

    def at(hertz: float) -> complex:
        _, found = signal.dfreqresp(plant, [2.0 * math.pi * hertz * step])
        return complex(found[0]) * lags(hertz, step, rig.speed_poles[0], rig.torque_poles[0])

    return at


def rigid_case(seed: int) -> tuple[Recording, Truth]:
    rig, _ = rigid(seed)
    motion, _ = planned(guess=RigGuess(rig.inertia, rig.viscous, rig.coulomb))
    return shaft_bench.simulate(rig, motion, [seed])[0], rigid_truth(rig)


def stribeck_case(seed: int) -> tuple[Recording, Truth]:
    """More friction at rest, in a bell that reaches into the speeds of the motion."""
    rig, rng = rigid(seed)
    rig = replace(rig, stribeck=rig.coulomb * rng.uniform(0.4, 1.0), stribeck_width=rng.uniform(1.5, 3.0))
    motion, _ = planned(guess=RigGuess(rig.inertia, rig.viscous, rig.coulomb))
    return shaft_bench.simulate(rig, motion, [seed])[0], rigid_truth(rig)


def zero_case(seed: int) -> tuple[Recording, Truth]:
    """The planned motion about lower mean speeds, so that the speed changes its sign."""
    rig, rng = rigid(seed)
    motion, _ = planned(guess=RigGuess(rig.inertia, rig.viscous, rig.coulomb))
    references, segments = [], []
    for reference, segment in zip(motion.references, motion.segments, strict=True):
        least = min(reference(0.1 * k)[0] for k in range(round(10.0 * segment.period_s)))
        lower = segment.offset_rad_s - (segment.offset_rad_s - least) * rng.uniform(0.0, 0.7)

        def lowered(at_s: float, inner=reference, by: float = lower) -> tuple[float, float]:
            speed, feed = inner(at_s)
            return speed - by, feed - rig.viscous * by - rig.coulomb * (speed < by)

        references.append(lowered)
        segments.append(replace(segment, offset_rad_s=segment.offset_rad_s - lower))
    crossing = replace(motion, references=tuple(references), segments=tuple(segments))
    return shaft_bench.simulate(rig, crossing, [seed])[0], rigid_truth(rig)


def compliant_case(seed: int, string: bool) -> tuple[Recording, Truth]:
    rng = np.random.default_rng([seed, 12])
    motor, load = 1500.0 * rng.uniform(0.7, 1.4), 374.0 * rng.uniform(0.7, 1.6)
    usual, by = compliant_bench.Noise(), 2.0 ** rng.uniform(-1.5, 0.5)
    noise = replace(usual, load_nm=by * usual.load_nm, sensor_rad_s=by * usual.sensor_rad_s,
                    torque_nm=by * usual.torque_nm)
    speed_s, torque_s = rng.uniform(0.0, 0.5), rng.uniform(0.0, 0.3)
    step = compliant_bench.DT
    if string:
        inertia = 214.56 * rng.uniform(0.6, 1.5)
        delay = step * round(rng.uniform(0.5, 0.9) / step)      # whole steps, as the bench moves its waves
        plant = compliant_bench.Pipe(motor, load, inertia, inertia / delay**2, rng.uniform(5.0, 20.0))
    else:
        plant = compliant_bench.TwoMass(motor, load, 473.0 * rng.uniform(0.6, 1.6), rng.uniform(12.0, 40.0))
    found = compliant_bench.run(plant, [seed], noise=noise, lags_s=(speed_s, torque_s), settle=8 if string else 4)[0]

    def at(hertz: float) -> complex:
        s = 2j * math.pi * hertz
        if string:       # torque is held over a step, and the speed is that before it
            shaft = (1.0 - np.exp(-s * step)) / (s * step) / plant.impedance(hertz)
        else:
            a, b = compliant_matrices(plant)
            held, driven, *_ = signal.cont2discrete((a, b, np.eye(3), np.zeros((3, 1))), step)
            shaft = np.linalg.solve(np.exp(s * step) * np.eye(3) - held, driven)[0, 0]
        return complex(shaft) * lags(hertz, step, speed_s, torque_s)

    return found, at


def compliant_matrices(p: compliant_bench.TwoMass) -> tuple[np.ndarray, np.ndarray]:
    """Return the state equations of ω_r, ω_L and the twist."""
    a = np.array([
        [-(p.damping + p.motor_viscous) / p.motor, p.damping / p.motor, -p.stiffness / p.motor],
        [p.damping / p.load, -(p.damping + p.load_viscous) / p.load, p.stiffness / p.load],
        [1.0, -1.0, 0.0],
    ])
    return a, np.array([[1.0 / p.motor], [0.0], [0.0]])


CASES: dict[str, Callable[[int], tuple[Recording, Truth]]] = {
    "rigid": rigid_case,
    "two-mass": lambda seed: compliant_case(seed, False),
    "string": lambda seed: compliant_case(seed, True),
    "zero": zero_case,
    "stribeck": stribeck_case,
}


def covered(found: FrequencyResponse, truth: Truth) -> list[tuple[bool, ...]]:
    """Return for each line which of the intervals of `PARTS` contain the truth."""
    seen = []
    for line in found.lines:
        g = truth(line.hertz)
        off = (np.angle(g) - line.phase_rad.value + math.pi) % (2.0 * math.pi) - math.pi
        half = line.phase_rad.high - line.phase_rad.value
        size, inertia = line.impedance_magnitude, line.apparent_inertia_kg_m2
        seen.append((
            line.magnitude.low <= abs(g) <= line.magnitude.high, bool(abs(off) <= half),
            size.low <= 1.0 / abs(g) <= size.high,
            inertia.low <= (1.0 / g).imag / (2.0 * math.pi * line.hertz) <= inertia.high))
    return seen


def covered_enough(name: str, by_position: list[list[bool]]) -> bool:
    """Print the coverage of all lines and of the worst positions; True if it is as required."""
    from scipy.stats import beta

    good = met(f"{name} covered, lines", sum(map(sum, by_position)), sum(map(len, by_position)), least=LEAST_COVERED)
    for position, each in enumerate(by_position):
        count, of = sum(each), len(each)
        most = 1.0 if count == of else float(beta.ppf(0.99, count + 1, of - count))
        if count < LEAST_COVERED * of:
            print(f"        {name} at line {position + 1}: {count / of:.1%} of {of} (99 % bound {most:.1%})"
                  f"{'' if most >= LEAST_COVERED else ' NOT MET'}")
        good &= most >= LEAST_COVERED
    return good


def study(kind: str, seeds: range) -> bool:
    """Run one kind. Return whether it meets its requirements."""
    by_position: list[list[tuple[bool, ...]]] = []
    flagged, none, wrong, begun = 0, [], [], time.monotonic()
    for number, seed in enumerate(seeds):
        if number and number % PROGRESS == 0:
            print(f"    {kind}: {number} plants, {flagged} flagged, {time.monotonic() - begun:.0f} s", flush=True)
        recording, truth = CASES[kind](seed)
        identified = identify(recording)
        found = identified.frequency_response
        if found is None:
            none.append(f"{seed}: {identified.reason}")
            continue
        test = found.distortion
        flagged += test.detected
        if kind in LINEAR:
            for position, one in enumerate(covered(found, truth)):
                if position == len(by_position):
                    by_position.append([])
                by_position[position].append(one)
        if test.detected is (kind in LINEAR):
            wrong.append(f"{seed}: harmonics {test.by_harmonics}, mean speeds {test.by_speed}")
    print(f"{kind}: {len(seeds)} plants, {time.monotonic() - begun:.0f} s")
    limit = {"most": MOST_FLAGGED} if kind in LINEAR else {"least": LEAST_FLAGGED}
    good = [met("without a response", len(none), len(seeds), most=0.0),
            met("distortion flagged", flagged, len(seeds) - len(none), **limit)]
    if kind in LINEAR:
        good += [covered_enough(name, [[one[part] for one in each] for each in by_position])
                 for part, name in enumerate(PARTS)]
    print("".join(f"    without a response: {one}\n" for one in none)
          + "".join(f"    flagged wrongly, p-values of {one}\n" for one in wrong), end="", flush=True)
    return all(good)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--plants", type=int, default=200)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--kinds", default=",".join(CASES))
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.plants)
    good = [study(kind, seeds) for kind in asked.kinds.split(",")]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
