"""Severity of torsional oscillation from surface signals, judged by simulated strings whose bit speed is known.

    python benchmarks/severity_from_surface.py                     # 24 strings, and 24 h of smooth drilling
    python benchmarks/severity_from_surface.py --strings 6 --hours 2

The strings are chains of masses and springs (tests/soft_torque/chain_in_time.py), which share no code with tdhil. What
is read of them has the noise, the resolution and the lags of an inverter's reports. Promised: stick-slip is found
within two periods, its frequency is right to 3 %, the downhole swing to 15 %, and smooth drilling raises no alarm.
Exit 1 if a promise is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tdhil.soft_torque import EXACT_STRING, Interval, SurfaceRecord, severity, string_modes_hz
from tests.soft_torque.cases import string_with
from tests.soft_torque.chain_in_time import recorded, reference_case, reported

LAGS_S = (0.10, 0.05)
LAWS = {"stiff": (20286.0, 26454.0, 0.0, 0.05), "paper": (4327.0, 4327.0, 0.0, 0.05), "soft": (847.0, 705.0, 0.0, 0.05)}


def drilled(length_m: float, rpm: list[float], law: str, seed: int, periods: float, noise_nm: float = 200.0):
    """Time, and torque, top and bit of every set speed; the string that tdhil believes; its period."""
    string = replace(string_with(length_m=length_m), tolerance=EXACT_STRING)
    period = 1.0 / string_modes_hz(string)[0]
    said = reference_case(length_m=length_m, noise_nm=noise_nm, laws=[LAWS[law]], seed=seed, period_s=period,
                          rpm=np.array([rpm]), periods=periods, own_noise=True, lumps=max(12, round(length_m / 150.0)))
    return (*recorded(**said), string, period)


def record_of(time_s, torque, top, seed: int) -> SurfaceRecord:
    """Return the record that the drive reports."""
    told = reported(time_s, torque, top, LAGS_S, seed)
    return SurfaceRecord(*told, *LAGS_S)


def true_figures(time_s, bit, period_s: float):
    """Median half of peak to peak over a period, frequency by the moments at which the bit breaks away."""
    size = round(period_s / (time_s[1] - time_s[0]))
    swings = [0.5 * np.ptp(bit[k:k + size]) for k in range(0, len(bit) - size, size // 4)]
    starts = time_s[1:][(bit[1:] > 0.0) & (bit[:-1] == 0.0)]
    starts = starts[np.concatenate([[True], np.diff(starts) > 0.5 * period_s])] if len(starts) else starts
    return float(np.median(swings)), 1.0 / float(np.mean(np.diff(starts))) if len(starts) > 2 else 0.0


def sticking(seed: int) -> str:
    """One string in stick-slip: what is missed, in words, and a line on stdout."""
    random = np.random.default_rng(seed)
    length, law = float(random.uniform(1000.0, 6000.0)), ("stiff", "paper")[seed % 2]
    rpm = float(random.uniform(60.0, 100.0))
    time_s, torque, top, bit, string, period = drilled(length, [rpm], law, seed, 14.0)
    late = time_s > 2.0 * period
    share = float(np.mean(bit[late, 0] == 0.0))
    swing, hertz = true_figures(time_s[late], bit[late, 0], period)
    inertia = Interval(1500.0, 1440.0, 1560.0)
    found = severity(record_of(time_s, torque[:, 0], top[:, 0], seed), string, inertia)
    if hertz == 0.0:
        print(f"{seed:4d} {law:5s} L {length:5.0f} {rpm:4.0f} rpm: turns; {found.level}, {100 * share:.0f} % stuck")
        return ""
    first = found.episodes[0].start_s - time_s[0] if found.episodes else np.inf
    known = found.period_s
    errors = {"late": first / period > 2.0,
              "frequency": known is None or abs(1.0 / known.value / hertz - 1.0) > 0.03,
              "swing": abs(found.downhole_rad_s.value / swing - 1.0) > 0.15,
              "interval": not (found.downhole_rad_s.low * 0.9 <= swing <= found.downhole_rad_s.high * 1.1)}
    missed = " ".join(name for name, wrong in errors.items() if wrong)
    seen = np.nan if known is None else 1.0 / known.value / hertz - 1.0
    print(f"{seed:4d} {law:5s} L {length:5.0f} {rpm:4.0f} rpm: found after {first / period:4.1f} periods, frequency "
          f"{100 * seen:+5.1f} %, swing {100 * (found.downhole_rad_s.value / swing - 1):+5.1f} %, index "
          f"{found.index.value:.2f}, share {found.stick_slip_share:.2f} {missed}", flush=True)
    return missed


def smooth(hours: float, seed: int) -> float:
    """Alarms in so many hours of rotation that never sticks, on strings of all lengths; each hour has its own noise."""
    alarms, done = 0, 0.0
    while done < hours - 1e-9:
        length = 1000.0 + 5000.0 * ((seed + done) * 0.618 % 1.0)
        count = max(1, min(12, round((hours - done) * 6.0)))
        period = 1.0 / string_modes_hz(string_with(length_m=length))[0]
        rpm = list(np.linspace(150.0, 220.0, count))
        time_s, torque, top, bit, string, period = drilled(length, rpm, "soft", seed + round(done), 600.0 / period + 12)
        late = time_s > 12.0 * period
        for k in range(count):
            if (bit[late, k] == 0.0).any():
                print(f"L {length:5.0f} {rpm[k]:.0f} rpm sticks and does not count")
                continue
            found = severity(record_of(time_s[late], torque[late, k], top[late, k], k), string,
                             Interval(1500.0, 1440.0, 1560.0))
            alarms += len(found.episodes)
            done += float(time_s[late][-1] - time_s[late][0]) / 3600.0
        print(f"{done:.1f} h, L {length:5.0f}: {alarms} alarms, worst index {found.index_worst:.2f}", flush=True)
    return alarms


def main() -> int:
    """Judge the strings, then the hours."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strings", type=int, default=24)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--hours", type=float, default=24.0)
    asked = parser.parse_args()
    begun = time.process_time()
    missed = [sticking(seed) for seed in range(asked.first, asked.first + asked.strings)]
    bad = sum(bool(one) for one in missed)
    alarms = smooth(asked.hours, 7 + asked.first) if asked.hours > 0.0 else 0
    print(f"{bad} of {asked.strings} strings miss a promise; {alarms} alarms in {asked.hours:g} h of smooth drilling; "
          f"{time.process_time() - begun:.0f} s of CPU")
    return int(bad > 0 or alarms > 0)


if __name__ == "__main__":
    sys.exit(main())
