"""Cost of identifying an hour at 1 kHz, against one least-squares fit of three columns on the same arrays.

    python benchmarks/identify_speed.py [--hours 1.0] [--rate 1000] [--out identify_speed.json]

The record is synthesised: two mean speeds of equal length, a multisine of six lines, the exact response of a rigid
shaft seen through two lags, white noise and rounding on both signals. It is identified without an angle, and with one
in 8,192 counts, which adds the searches for harmonics of the angle and for backlash. The fit is `numpy.linalg.lstsq` of
the torque on [α, ω, 1], α the difference of the speed; making its columns is not counted. Both are run in this process,
one after the other, and the best of three counts. Memory is the peak of what Python and numpy ask for beyond the record
itself (tracemalloc), in a run of its own, and the record's bytes are added to it: 3 × means record and all.

Required of both records: at most 10 fits, and 3 records. The exit code is 1 otherwise.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import tracemalloc
from pathlib import Path

import numpy as np

from tdhil.estimation import Options, identify
from tdhil.recording.recording import Excitation, Recording, Segment

MOST_FITS, MOST_RECORDS = 10.0, 3.0     # of time (issue 29), and of memory
COUNTS = 8192                           # of the angle, a turn
PERIOD_S, OFFSETS = 20.0, (2.2, 5.0)
LINES = (0.05, 0.1, 0.15, 0.25, 0.35, 0.5)
AMPLITUDES = (0.25, 0.25, 0.25, 0.38, 0.33, 0.20)
PHASES = (0.0, 2.1, 4.9, 1.2, 3.3, 5.6)
SPEED_QUANTUM, TORQUE_QUANTUM = 0.0105, 1.0


def synthesised(hours: float, rate_hz: float, angle: bool = False) -> Recording:
    """J 104 kg·m², B 8 N·m·s/rad, Coulomb 60 N·m, lags 0.40 and 0.15 s. ``angle``: the drive reports it."""
    rng = np.random.default_rng(1)
    periods = max(3, round(hours * 3600.0 / PERIOD_S / len(OFFSETS)))
    length = periods * PERIOD_S
    count = round(length * rate_hz)
    s = 2j * np.pi * np.array(LINES)
    wave = np.array(AMPLITUDES) * np.exp(1j * np.array(PHASES))
    response = (104.0 * s + 8.0) * (1.0 + 0.40 * s) / (1.0 + 0.15 * s)
    own = np.arange(count) / rate_hz
    speed, torque = np.empty(len(OFFSETS) * count), np.empty(len(OFFSETS) * count)
    for number, offset in enumerate(OFFSETS):
        part = slice(number * count, (number + 1) * count)
        speed[part], torque[part] = offset, 60.0 + 8.0 * offset
        for k in range(len(LINES)):
            turned = np.exp(s[k] * own)
            speed[part] += (turned * wave[k]).real
            torque[part] += (turned * wave[k] * response[k]).real
    turned_counts = np.floor(np.cumsum(speed) * (COUNTS / (2.0 * np.pi * rate_hz))) if angle else None
    speed += 0.003 * rng.standard_normal(len(speed))
    torque += 4.0 * rng.standard_normal(len(torque))
    return Recording(
        time_s=np.arange(len(speed)) / rate_hz,
        speed_rad_s=np.round(speed / SPEED_QUANTUM) * SPEED_QUANTUM,
        torque_nm=np.round(torque / TORQUE_QUANTUM) * TORQUE_QUANTUM,
        fresh=np.ones(len(speed), dtype=np.bool_),
        limited=np.zeros(len(speed), dtype=np.bool_),
        excitation=Excitation("multisine", "torque", tuple(
            Segment(number * length, (number + 1) * length, PERIOD_S, 1, offset, LINES, AMPLITUDES, PHASES)
            for number, offset in enumerate(OFFSETS)
        )),
        speed_resolution_rad_s=SPEED_QUANTUM,
        torque_resolution_nm=TORQUE_QUANTUM,
        torque_limit_nm=400.0,
        position_rad=None if turned_counts is None else turned_counts * (2.0 * np.pi / COUNTS),
    )


def fit_s(recording: Recording, tries: int) -> float:
    """The best time of one least-squares fit of three columns."""
    columns = np.column_stack([
        np.gradient(recording.speed_rad_s, recording.time_s), recording.speed_rad_s, np.ones(len(recording.time_s))
    ])
    return best_s(lambda: np.linalg.lstsq(columns, recording.torque_nm, rcond=None), tries)


def best_s(what, tries: int) -> float:
    best = float("inf")
    for _ in range(tries):
        begun = time.perf_counter()
        what()
        best = min(best, time.perf_counter() - begun)
    return best


def peak_bytes(recording: Recording, options: Options) -> int:
    """The most that identification holds at once beyond the record."""
    tracemalloc.start()
    try:
        identify(recording, options)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def measured(recording: Recording, tries: int) -> dict[str, float]:
    """Identify a record. Print and return its figures."""
    options = Options()
    own = sum(part.nbytes for part in (
        recording.time_s, recording.speed_rad_s, recording.torque_nm, recording.fresh, recording.limited,
        recording.position_rad) if part is not None)
    found = identify(recording, options)
    said = "no number" if found.inertia is None else f"J {found.inertia.low:.2f} … {found.inertia.high:.2f} kg·m²"
    print(f"{len(recording.time_s)} samples{'' if recording.position_rad is None else ' with angle'}: "
          f"{found.verdict.value}, {said} (truth 104)")
    one_fit = fit_s(recording, tries)
    whole = best_s(lambda: identify(recording, options), tries)
    peak = peak_bytes(recording, options)
    figures = {
        "samples": len(recording.time_s), "lstsq_s": one_fit, "identify_s": whole, "fits": whole / one_fit,
        "record_bytes": own, "beyond_record_bytes": peak, "records": (own + peak) / own,
    }
    print(f"    one fit of three columns {one_fit:.2f} s, identification {whole:.2f} s: {figures['fits']:.1f} fits "
          f"(at most {MOST_FITS:g})")
    print(f"    record {own / 1e6:.0f} MB, peak beyond it {peak / 1e6:.0f} MB (tracemalloc): {figures['records']:.2f} "
          f"records in all (at most {MOST_RECORDS:g})", flush=True)
    return figures


def main() -> int:
    """0 if both bounds hold for both records."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="samples a second")
    parser.add_argument("--tries", type=int, default=3)
    parser.add_argument("--out", type=Path, help="the figures as JSON")
    wanted = parser.parse_args()
    figures = {name: measured(synthesised(wanted.hours, wanted.rate, angle), wanted.tries)
               for name, angle in (("without_angle", False), ("with_angle", True))}
    if wanted.out:
        wanted.out.write_text(json.dumps(figures, indent=2) + "\n")
    return 0 if all(one["fits"] <= MOST_FITS and one["records"] <= MOST_RECORDS for one in figures.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
