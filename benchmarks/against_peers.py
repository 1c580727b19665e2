"""Ours beside what one would use instead, on the same random records: accuracy, coverage, refusals, time.

    python -m venv --system-site-packages DIR && DIR/bin/pip install sippy-unipi==1.0.1     # or into tdhil's own
    python benchmarks/against_peers.py [--rigs 50] [--first 0] [--keep DIR] [--out records.jsonl] [--picture FILE]

The records are those of benchmarks/random_rigs.py, four motions a rig: 50 rigs are 200 records. Everybody gets the
same CSV file: time, speed and torque as the drive reports them; of a multisine ours is told its periods, as a user
would. `PEERS` says what each does. What a peer leaves open (filter, rate, order, which samples) is set as whoever knows
it well would, and was tried on rigs 1000 to 1009 before these were looked at. Without SIPPY its rows are left out.

Error: share of the true inertia. Covers: how many of the intervals, of 95 %, hold the truth. Refused: no number, or
none that is positive. Time: CPU seconds a record, reading it included.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import json
import math
import os
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

import tdhil
from benchmarks import random_rigs

FloatArray = NDArray[np.float64]
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "against_peers.png"
CONFIDENCE = 0.95
MOVING = 0.05           # of the record's highest speed: below, friction is no straight line for anybody


@dataclass(frozen=True)
class Trace:
    """Reported signals, (N,): s, rad/s, N·m."""

    time_s: FloatArray
    speed: FloatArray
    torque: FloatArray

    @property
    def moving(self) -> NDArray[np.bool_]:
        return np.abs(self.speed) > MOVING * np.max(np.abs(self.speed))

    def even(self, rate_hz: float | None = None) -> tuple[Trace, float]:
        """On an even grid, at its own rate or a lower one, what lies above half of that filtered away; its step."""
        step = (self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1)
        grid = self.time_s[0] + step * np.arange(len(self.time_s))
        speed, torque = np.interp(grid, self.time_s, self.speed), np.interp(grid, self.time_s, self.torque)
        each = 1 if rate_hz is None else max(1, math.floor(1.0 / (step * rate_hz)))
        if each > 1:
            low = signal.butter(4, 0.8 / each, output="sos")
            speed, torque = (signal.sosfiltfilt(low, one)[::each] for one in (speed, torque))
        return Trace(grid[::each], speed, torque), step * each

    def band_hz(self) -> float:
        """Below this lie 95 % of what the speed does besides its mean."""
        even, step = self.even()
        hertz, power = signal.periodogram(even.speed, 1.0 / step, detrend="constant")
        return float(hertz[np.searchsorted(np.cumsum(power), 0.95 * power.sum())])


@dataclass(frozen=True)
class Answer:
    """J in kg·m², with the half-width of its interval where there is one."""

    inertia: float
    low: float = math.nan
    high: float = math.nan


def regress(columns: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ordinary least squares: the coefficients and their half-widths, errors taken for independent."""
    found, _, rank, _ = np.linalg.lstsq(columns, wanted, rcond=None)
    if rank < columns.shape[1]:
        raise ValueError("columns depend on each other")
    free = len(wanted) - columns.shape[1]
    variance = float(np.sum((wanted - columns @ found) ** 2)) / free
    sd = np.sqrt(variance * np.diag(np.linalg.inv(columns.T @ columns)))
    return found, sd * stats.t.ppf(0.5 + 0.5 * CONFIDENCE, free)


# -- the peers ---------------------------------------------------------------------------------------------------------


def paper(trace: Trace) -> Answer:
    """T = J α + b, α from the speed's change over 0.1 s, the torque's mean over the same 0.1 s; turning forward."""
    marks = np.arange(trace.time_s[0], trace.time_s[-1], 0.1)
    ends = np.unique(np.searchsorted(trace.time_s, marks))
    span = np.diff(trace.time_s[ends])
    impulse = np.concatenate(([0.0], np.cumsum(
        0.5 * (trace.torque[1:] + trace.torque[:-1]) * np.diff(trace.time_s))))
    forward = trace.moving & (trace.speed > 0.0)
    kept = forward[ends[1:]] & forward[ends[:-1]]
    alpha, torque = np.diff(trace.speed[ends])[kept] / span[kept], np.diff(impulse[ends])[kept] / span[kept]
    found, _ = regress(np.column_stack((alpha, np.ones_like(alpha))), torque)
    return Answer(float(found[0]))


def least_squares(trace: Trace) -> Answer:
    """T = J α + B ω + T_c sgn ω, by ordinary least squares.

    As is usual for robots' parameters: one filter without phase, half as wide again as the motion, goes over speed and
    torque alike; α is the central difference; of each half-period of the cut-off one sample is kept.
    """
    even, step = trace.even()
    cut_hz = min(1.5 * trace.band_hz(), 0.4 / step)
    low = signal.butter(4, cut_hz, fs=1.0 / step, output="sos")
    speed, torque = signal.sosfiltfilt(low, even.speed), signal.sosfiltfilt(low, even.torque)
    alpha = np.gradient(speed, step)
    keep = np.zeros(len(speed), np.bool_)
    keep[:: max(1, math.floor(0.5 / (cut_hz * step)))] = True
    reach = math.ceil(0.5 / (cut_hz * step))                  # leaves out the filter's smear of ends and standstills
    still = np.pad(~even.moving, reach, constant_values=True)
    keep &= signal.convolve(still.astype(np.float64), np.ones(2 * reach + 1), "valid") < 0.5
    columns = np.column_stack((alpha, speed, np.sign(speed)))[keep]
    if len(np.unique(columns[:, 2])) == 1 and np.ptp(columns[:, 1]) < 1e-9:
        columns = columns[:, [0, 2]]
    found, half = regress(columns, torque[keep])
    return Answer(float(found[0]), float(found[0] - half[0]), float(found[0] + half[0]))


def wpilib(trace: Trace) -> Answer:
    """SysId's feed-forward analysis: α = −(k_V/k_A) ω + (1/k_A) T − (k_S/k_A) sgn ω by least squares; k_A is J.

    As its sources have it: the acceleration is what is explained, as the noisiest; slow samples are left out; a median
    filter over the speed, here of 9; central differences; none that are zero. At the 50 Hz of a robot's loop. It gives
    no interval. (allwpilib, sysid: FeedforwardAnalysis, FilteringUtils; docs.wpilib.org, System Identification.)
    """
    even, step = trace.even(50.0)
    speed = signal.medfilt(even.speed, 9)
    alpha = np.zeros_like(speed)
    alpha[1:-1] = (speed[2:] - speed[:-2]) / (2.0 * step)
    kept = even.moving & (alpha != 0.0)
    kept[[0, -1]] = False
    columns = np.column_stack((speed, even.torque, np.sign(speed)))[kept]
    (_, beta, _), _ = regress(columns, alpha[kept])
    return Answer(float(1.0 / beta))


def armax(trace: Trace) -> Answer:
    """SIPPY's ARMAX from torque to speed, of order 3: the shaft, and room for the filters of the reports."""
    found, unit = _sippy(trace, "ARMAX", ARMAX_orders=[3, 3, 3, 0], max_iterations=100)
    a, b, c, _ = signal.tf2ss(np.ravel(found.G.num[0][0]), np.ravel(found.G.den[0][0]))
    return Answer(unit * _of_slow_pole(a, b, c))


def parsim(trace: Trace) -> Answer:
    """SIPPY's PARSIM-K, made for data from closed loops, of order 2."""
    found, unit = _sippy(trace, "PARSIM-K", SS_fixed_order=2, SS_f=15, SS_p=15)
    return Answer(unit * _of_slow_pole(found.A, found.B, found.C))


def _sippy(trace: Trace, method: str, **options: object) -> tuple[Any, float]:
    """A model of the longest stretch that turns one way, at forty times its band, without means (and so without Coulomb
    friction), each signal over its spread; and what an inertia of that model is in kg·m².
    """
    even, step = trace.even(40.0 * trace.band_hz())
    way = np.sign(even.speed) * even.moving
    edges = np.flatnonzero(np.diff(way) != 0.0) + 1
    first, last = max(((a, b) for a, b in zip([0, *edges], [*edges, len(way)], strict=True) if way[a] != 0.0),
                      key=lambda one: one[1] - one[0])
    speed, torque = (one[first:last] - np.mean(one[first:last]) for one in (even.speed, even.torque))
    import sippy_unipi

    high, wide = np.std(speed), np.std(torque)
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = sippy_unipi.system_identification(
            speed[None] / high, torque[None] / wide, method, tsample=step, **options)
    return found, float(step * wide / high)


def _of_slow_pole(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """J, in steps, from the pole p of a discrete model that does most at rest: whatever faster filters stand beside it,
    1/(J s + B) has the residue 1/J there, which a torque held from sample to sample makes (p − 1)/(J ln p).
    """
    poles, right = np.linalg.eig(a)
    residues = np.ravel(c @ right) * np.ravel(np.linalg.solve(right, b))
    steady = (np.abs(poles.imag) < 1e-9) & (poles.real > 0.5)
    if not steady.any():
        raise ValueError("every slow pole swings")
    slow = int(np.argmax(np.where(steady, np.abs(residues / np.maximum(np.abs(1.0 - poles), 1e-6)), -1.0)))
    p, r = float(poles[slow].real), float(residues[slow].real)
    return ((p - 1.0) / math.log(p) if abs(p - 1.0) > 1e-9 else 1.0) / r


def ours(path: Path) -> Answer:
    """`tdhil.identify`; its interval is the repeatability, since the torque here has no error of scale."""
    declared = path.with_suffix(".yaml")
    one = tdhil.identify(tdhil.read(path, excitation=declared if declared.exists() else None)).to_dict()
    inertia = one["inertia_kg_m2"]
    if inertia is None:
        raise ValueError(one["verdict"])
    return Answer(inertia["value"], inertia["low"], inertia["high"])


PEERS: dict[str, Callable[[Trace], Answer]] = {
    "acceleration regression (Xu 2026)": paper, "least squares": least_squares, "WPILib SysId": wpilib,
    "SIPPY ARMAX": armax,
    "SIPPY PARSIM-K": parsim,
}
OURS = "tdhil"


# -- the table ---------------------------------------------------------------------------------------------------------


@dataclass
class Row:
    """One record by one method; NaN where it has no number or no interval."""

    method: str
    rig: int
    cause: str
    motion: str
    error: float = math.nan
    half: float = math.nan
    covers: bool = False
    why: str = ""
    cpu_s: float = 0.0


def read(path: Path) -> Trace:
    return Trace(*np.loadtxt(path, delimiter=",", skiprows=1, unpack=True))


def judged(method: str, path: Path, rig: random_rigs.Rig, motion: str) -> Row:
    row = Row(method, rig.number, rig.cause, motion)
    began = time.process_time()
    try:
        answer = ours(path) if method == OURS else PEERS[method](read(path))
    except Exception as error:
        row.why = f"{type(error).__name__}: {error}"[:80]
    else:
        if math.isfinite(answer.inertia) and answer.inertia > 0.0:
            row.error = answer.inertia / rig.inertia - 1.0
            row.half = 0.5 * (answer.high - answer.low) / rig.inertia
            row.covers = answer.low <= rig.inertia <= answer.high
        else:
            row.why = "not positive"
    row.cpu_s = time.process_time() - began
    return row


def table(rows: list[Row], motions: tuple[str, ...] = random_rigs.MOTIONS) -> Iterator[str]:
    """Markdown: a row a method; shares in %."""
    yield "| | median error | p90 error | refused | interval, ± | covers | CPU s |"
    yield "|---|---|---|---|---|---|---|"
    for method in dict.fromkeys(row.method for row in rows):
        mine = [row for row in rows if row.method == method and row.motion in motions]
        told = [row for row in mine if math.isfinite(row.error)]
        errors = 100.0 * np.abs([row.error for row in told])
        sized = [row for row in told if math.isfinite(row.half)]
        interval = (f"{100.0 * np.median([row.half for row in sized]):.2g} % | "
                    f"{100.0 * np.mean([row.covers for row in sized]):.1f} %" if sized else "– | –")
        yield (f"| {method} | {np.median(errors):.2g} % | {np.quantile(errors, 0.9):.2g} % | "
               f"{100.0 * (1.0 - len(told) / len(mine)):.1f} % | {interval} | "
               f"{np.mean([row.cpu_s for row in mine]):.2f} |")


def draw(rows: list[Row], path: Path) -> None:
    """Which share of all records each method has within which error."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from tdhil.report import repeatable_figures

    with repeatable_figures():
        figure = Figure(figsize=(8.0, 3.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        colours = ("#1f5fa8", "0.55", "#c2410c", "#7a5195", "#2e7d32", "#b8860b")
        for method, colour in zip(dict.fromkeys(row.method for row in rows), colours, strict=False):
            mine = [row for row in rows if row.method == method]
            errors = np.sort([100.0 * abs(row.error) for row in mine if math.isfinite(row.error)])
            share = 100.0 * np.arange(1, len(errors) + 1) / len(mine)
            axes.step(np.maximum(errors, 0.01), share, where="post", color=colour, label=method,
                      lw=2.0 if method == OURS else 1.2)
        axes.set(xscale="log", xlim=(0.01, 300.0), ylim=(0.0, 100.0), xlabel="error of J, at most, %",
                 ylabel="of all records, %")
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize="small", loc="upper left")
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rigs", type=int, default=50)
    parser.add_argument("--first", type=int, default=0, help="number of the first rig")
    parser.add_argument("--methods", nargs="+", default=[OURS, *PEERS], help="these only")
    parser.add_argument("--keep", type=Path, help="a folder for the records, read again if they are there")
    parser.add_argument("--out", type=Path, help="every answer as a line of JSON")
    parser.add_argument("--picture", type=Path, nargs="?", const=PICTURE, help="draw it, into docs/images by default")
    asked = parser.parse_args()
    methods = list(asked.methods)
    if importlib.util.find_spec("sippy_unipi") is None:
        methods = [one for one in methods if not one.startswith("SIPPY")]
        print("SIPPY is not installed: its rows are left out")
    wanted = [(random_rigs.draw(number), motion, 0) for number in range(asked.first, asked.first + asked.rigs)
              for motion in random_rigs.MOTIONS]
    with TemporaryDirectory() as temporary:
        folder = asked.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        random_rigs.make(folder, wanted)
        for method in methods:                       # imports at the first record do not count
            judged(method, random_rigs.written(folder, *wanted[0]), *wanted[0][:2])
        rows = []
        with asked.out.open("w", encoding="utf-8") if asked.out else contextlib.nullcontext() as out:
            for one in wanted:
                rows += [judged(method, random_rigs.written(folder, *one), *one[:2]) for method in methods]
                if out is not None:
                    out.writelines(json.dumps(asdict(row)) + "\n" for row in rows[-len(methods):])
                    out.flush()
    rows.sort(key=lambda row: methods.index(row.method))
    print(f"{len(wanted)} records of {asked.rigs} rigs\n", *table(rows), sep="\n")
    for motion in random_rigs.MOTIONS:
        print(f"\n{motion}\n", *table(rows, (motion,)), sep="\n")
    print("\nrefused:", *(f"{count:>4} × {method}: {why}" for (method, why), count in Counter(
        (row.method, row.why) for row in rows if row.why).most_common(20)), sep="\n")
    if asked.picture:
        draw(rows, asked.picture)


if __name__ == "__main__":
    main()
