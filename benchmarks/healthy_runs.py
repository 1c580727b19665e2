"""Random healthy rigs through the real path with the embedded simulator: how many runs end with a false alarm?

    python benchmarks/healthy_runs.py [--runs 2000] [--first 1] [--jobs 1] [--out rows.jsonl] [--against old.jsonl]
                                      [--keep logs | --replay logs]

Each seed draws a profile that ships (both buses), a shaft (rigid, two masses, drill string; J from 0.02 to 3000 kg·m²;
each law of friction), what disturbs it, how late and how coarsely the drive reports, and a cycle rate; the limits fit
the shaft. Every report is honest. A row of the table is a cause that ended runs. An alarm is a cause whose class name
says that reports contradict each other or that the bus failed (frozen feedback), or a stop that was not confirmed. A
rig that is refused before its drive was enabled does not count. An interval is held against the inertia that the result
names: the motor's, that of motor and load together, or either where it states that the data do not tell. `--against`
compares every interval of J with that of another commit. `--keep` keeps the log of each run; `--replay` identifies
these logs again instead of moving a shaft, which takes a tenth of the time after a change of the identification only.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402

from benchmarks.called_here import Called, called_here  # noqa: E402
from benchmarks.kept_rows import kept_rows  # noqa: E402
from profiles import MessageCode  # noqa: E402
from profiles.library import load_profile, profile_names  # noqa: E402
from sim_bus.plant.drill_string import StringParams  # noqa: E402
from sim_bus.shaft_judge import read_shaft  # noqa: E402
from tdhil.errors import ExitCode  # noqa: E402

ALARMS = ("ReportsContradict", "CommunicationLost")
"""Class names of the observer's errors. No bus of a healthy rig fails."""

WIDER = 1e-9
"""An interval counts as wider from this relative difference on."""

TURNS_AS_ONE, MAY_STAY_BEHIND = MessageCode.STRING_MOVES_WITH_MOTOR.code, MessageCode.LOAD_MAY_STAY_BEHIND.code
"""Codes of the warnings that J is that of motor and load together; and that it is this or the motor's alone."""

SHAFTS = ("rigid",) * 6 + ("two_mass",) * 2 + ("string",) * 2
FRICTIONS = ("coulomb", "stribeck", "dahl", "lugre")
RATES_HZ = (10.0, 250.0)
STRING_FROM_KG_M2 = 300.0


@dataclass(frozen=True)
class Rig:
    """Rig drawn from a seed: plant.yaml and rig.yaml as mappings, and the command line."""

    seed: int
    profile: str
    shaft: str
    friction: str
    inertia_kg_m2: float
    joined_inertia_kg_m2: float
    rate_hz: float
    plant: dict[str, Any]
    rig: dict[str, Any]
    arguments: tuple[str, ...]


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Evenly on a logarithmic scale."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def round_up(value: float) -> float:
    """To three digits."""
    return float(f"{value:.3g}")


def holds_a_string(name: str) -> bool:
    """Its drive holds the shaft after a quick stop, by command and by its watchdog; any other is refused."""
    profile = load_profile(name)
    return profile.quick_stop.ends == "quick_stop" and profile.watchdog.reaction == "quick_stop"


def roomy(profile: str, names: Sequence[str], rated_torque_nm: float) -> str:
    """Return this profile, or the next whose object of the rated torque can hold it. An EPOS4 ends at 4,295 N·m."""
    at = names.index(profile)
    for name in (*names[at:], *names[:at]):
        per_count_nm = getattr(getattr(load_profile(name), "torque", None), "rated_torque_nm_per_lsb", None)
        if per_count_nm is None or rated_torque_nm / per_count_nm < 2.0**32:
            return name
    raise AssertionError("no profile holds this rated torque")


def draw(seed: int) -> Rig:
    """The rig of this seed."""
    rng = np.random.default_rng([seed, 202611])
    names = sorted(profile_names())
    shaft = str(rng.choice(SHAFTS))
    fits = [name for name in names if shaft == "rigid" or holds_a_string(name)]
    profile = fits[int(rng.integers(len(fits)))]
    inertia = round_up(between(rng, STRING_FROM_KG_M2 if shaft != "rigid" else 0.02, 3000.0))
    size = math.log10(inertia / 0.02) / math.log10(3000.0 / 0.02)
    top = round_up(10.0 ** (2.2 - 1.2 * size) * rng.uniform(0.8, 1.3))
    share = rng.uniform(0.05, 0.3)
    torque = round_up(inertia * top / rng.uniform(2.0, 5.0) / (1.0 - share))
    dry = rng.uniform(0.2, 0.8)
    coulomb, viscous = dry * share * torque, (1.0 - dry) * share * torque / top
    friction = str(rng.choice(FRICTIONS))
    plant: dict[str, Any] = {
        "kind": shaft, "inertia_kg_m2": inertia, "coulomb_nm": coulomb, "viscous_nm_s_rad": viscous,
        "friction": friction,
    }
    plant |= _friction(friction, coulomb, inertia, top, rng)
    load: dict[str, Any] = {}
    if shaft != "rigid":
        plant["bottom"] = {"inertia_kg_m2": round_up(rng.uniform(0.1, 0.3) * inertia),
                           "viscous_nm_s_rad": 0.1 * viscous, "coulomb_nm": rng.uniform(0.0, 0.3) * coulomb}
        load = {"make_up_torque_nm": round_up(4.0 * torque), "torque_ramp_nm_s": round_up(0.1 * torque)}
    if shaft == "two_mass":
        swing_rad_s = 2.0 * math.pi * rng.uniform(0.12, 0.5)
        plant["stiffness_nm_rad"] = plant["bottom"]["inertia_kg_m2"] * swing_rad_s**2
        plant["damping_nm_s_rad"] = rng.uniform(0.02, 0.1) * plant["bottom"]["inertia_kg_m2"] * swing_rad_s
        load["load"] = {"kind": "string"}
    elif shaft == "string":
        length_m = round(rng.uniform(500.0, 3500.0))
        plant["length_m"] = length_m
        load["load"] = {"kind": "string"} | ({} if rng.random() < 0.5 else {
            "length_m": length_m, "outer_diameter_m": 0.127, "inner_diameter_m": 0.1086})
    noisy = between(rng, 0.2, 1.0)
    rated = round_up(torque * rng.uniform(1.0, 3.0))
    profile = roomy(profile, fits, rated)
    gain = inertia * rng.uniform(2.0, 4.0)
    bottom_load = rng.uniform(0.0, 0.02) * torque if shaft != "rigid" and rng.random() < 0.5 else 0.0
    quick_stop = round_up(0.5 * torque / inertia)
    whole = {
        "plant": plant,
        "drive": {
            "rated_torque_nm": rated, "torque_limit_nm": round_up(torque * 1.2),
            "speed_limit_rpm": round_up(top * 1.3 * 60.0 / (2.0 * math.pi)), "speed_gain_nm_s_rad": gain,
            "speed_integral_gain_nm_rad": gain * rng.uniform(0.4, 1.2),
            "quick_stop_rad_s2": quick_stop,      # set at a drive that does not take it from a host
        },
        "reporting": {
            "speed_lag_s": 0.0 if rng.random() < 0.15 else rng.uniform(0.0, 0.5),
            "torque_lag_s": 0.0 if rng.random() < 0.15 else rng.uniform(0.0, 0.3),
            "speed_noise_rad_s": 0.0003 * noisy * top, "torque_noise_nm": 0.005 * noisy * torque,
            "speed_quantum_rpm": float(rng.choice([0.0, 0.1, 1.0])) * top / 20.0,
            "torque_quantum_permille": float(rng.choice([0.1, 1.0, 5.0])),
        },
        "noise": {
            "speed_sensor_rad_s": 0.0012 * noisy * top, "torque_nm": 0.02 * noisy * torque,
            "load_nm": rng.uniform(0.0, 0.015) * torque, "load_correlation_s": between(rng, 0.2, 5.0),
            "bottom_load_nm": bottom_load,
        },
    }
    rate_hz = round_up(between(rng, *RATES_HZ))
    rig = {
        "limits": {
            "speed_min_rad_s": round_up(0.05 * top), "speed_max_rad_s": top, "torque_nm": torque, "time_s": 1800,
            "quick_stop_rad_s2": quick_stop, "watchdog_s": 0.5,
            "probe_torque_nm": round_up(min(0.8 * torque, 2.5 * coulomb + 0.2 * torque)),
            "probe_travel_rad": round_up(max(3.0, 0.5 * top)),
        },
        "drive_data": {"rated_torque_nm": rated},
    } | load
    arguments = ("identify", "--simulate", "--profile", profile, "--rate", f"{rate_hz:g}", "--seed", str(seed),
                 "--periods", "4", *_overrides(profile))
    return Rig(seed, profile, shaft, friction, inertia, joined_inertia(plant), rate_hz, whole, rig, arguments)


def joined_inertia(plant: dict[str, Any]) -> float:
    """Moment of inertia of motor and load together, kg·m²."""
    inertia = plant["inertia_kg_m2"] + plant.get("bottom", {}).get("inertia_kg_m2", 0.0)
    if plant["kind"] == "string":
        pipe = StringParams(length_m=plant["length_m"])
        inertia += pipe.density_kg_m3 * pipe.polar_moment_m4 * pipe.length_m
    return float(inertia)


def _overrides(profile: str) -> tuple[str, ...]:
    return ("--accept-no-watchdog",) if load_profile(profile).watchdog.kind == "none" else ()


def _friction(kind: str, coulomb: float, inertia: float, top: float, rng: np.random.Generator) -> dict[str, float]:
    """The parameters of a law beside those of dry and viscous friction."""
    if kind == "dahl":
        return {"dahl_stiffness_nm_rad": coulomb / rng.uniform(0.005, 0.02)}
    if kind in {"stribeck", "lugre"}:
        more = {"static_nm": coulomb * rng.uniform(1.0, 1.4), "stribeck_speed_rad_s": rng.uniform(0.01, 0.03) * top}
        if kind == "lugre":
            more |= {"lugre_stiffness_nm_rad": coulomb / rng.uniform(0.003, 0.01),
                     "lugre_damping_nm_s_rad": 5.0 * inertia}
        return more
    return {}


def run(rig: Rig, folder: Path) -> dict[str, Any]:
    """One run in this process."""
    for name, content in (("plant.yaml", rig.plant), ("rig.yaml", rig.rig)):
        (folder / name).write_text(json.dumps(content), encoding="utf-8")        # JSON is YAML
    trace = folder / "shaft.csv"
    here = called_here([*rig.arguments, "--plant", str(folder / "plant.yaml"), "--rig", str(folder / "rig.yaml"),
                        "--json", "--log", str(folder / "run.mcap"), "--trace", str(trace)])
    shaft = read_shaft(trace) if trace.exists() else None
    return row_of(rig, here, moved=shaft is not None and bool(shaft.enabled.any()))


def row_of(rig: Rig, here: Called, *, moved: bool) -> dict[str, Any]:
    """Return the row of a run or of the replay of its log."""
    document = here.document
    error, inertia = document.get("error") or {}, document.get("inertia_kg_m2") or {}
    cause = error.get("kind") or ("" if "verdict" in document else f"exit {here.code}")
    message = error.get("message") or document.get("reason") or document.get("stop") or here.said[-300:]
    return {
        "seed": rig.seed, "profile": rig.profile, "shaft": rig.shaft, "friction": rig.friction,
        "inertia_kg_m2": rig.inertia_kg_m2, "joined_inertia_kg_m2": rig.joined_inertia_kg_m2,
        "measurand": measurand(document), "rate_hz": rig.rate_hz, "exit_code": here.code, "cause": cause,
        "message": message[:300], "moved": moved,
        "verdict": document.get("verdict"), "low": inertia.get("low_total"), "high": inertia.get("high_total"),
        "took_s": round(here.took_s, 2),
    }


def measurand(document: dict[str, Any]) -> str:
    """Name the inertia that J is, by the warnings: motor, joined or either."""
    codes = document.get("warning_codes", ())
    return "joined" if TURNS_AS_ONE in codes else "either" if MAY_STAY_BEHIND in codes else "motor"


def covers(row: dict[str, Any]) -> bool:
    """Return whether the interval contains the inertia that the result names."""
    motor, joined = (row["low"] <= row[name] <= row["high"] for name in ("inertia_kg_m2", "joined_inertia_kg_m2"))
    return {"motor": motor, "joined": joined, "either": motor or joined}[row["measurand"]]


def work(seed: int, keep: Path | None = None) -> dict[str, Any]:
    """One seed, in a folder of its own; its log then goes to ``keep``."""
    with tempfile.TemporaryDirectory() as folder:
        row, log = run(draw(seed), Path(folder)), Path(folder) / "run.mcap"
        if keep is not None and log.exists():
            shutil.move(log, keep / f"{seed}.mcap")
        return row


def replay(seed: int, logs: Path) -> dict[str, Any]:
    """Identify the kept log of one seed again."""
    return row_of(draw(seed), called_here(["replay", str(logs / f"{seed}.mcap"), "--json"]), moved=True)


def line(row: dict[str, Any]) -> str:
    """A run in a line."""
    interval = ""
    if row["low"] is not None:
        interval = f"J [{row['low']:.4g}, {row['high']:.4g}]{'' if covers(row) else '  MISSES'}"
    why = f"{row['cause']}: {row['message'][:110]}" if row["cause"] else ""
    return (f"{row['seed']:>6} {row['profile']:<21}{row['shaft']:<9}{row['friction']:<9}"
            f"{row['inertia_kg_m2']:>8g} kg·m² {row['rate_hz']:>5g} Hz {row['took_s']:5.1f} s "
            f"exit {row['exit_code']:>3} {row['verdict'] or '-':<17}{interval}{why}"
            f"{'' if row['moved'] else '  (never enabled)'}")


def alarm(row: dict[str, Any]) -> bool:
    """Return whether its reports were not believed, or its standstill not."""
    return row["cause"] in ALARMS or row["exit_code"] == int(ExitCode.STOP_NOT_CONFIRMED)


def alarms(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Those that were stopped or left since their reports were not believed."""
    return [row for row in rows if alarm(row)]


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Counts by cause."""
    counted = [row for row in rows if row["moved"]]
    lines = ["", f"{len(rows)} rigs, {len(rows) - len(counted)} refused before motion, {len(counted)} runs, "
             f"{sum(row['took_s'] for row in rows):.0f} s of processor time"]
    for cause, count in Counter(row["cause"] or "none: went to its end" for row in counted).most_common():
        lines.append(f"  {count:>5}  {cause}")
    told = [row for row in counted if row["low"] is not None and row["verdict"] in ("valid", "valid_wide")]
    missed = [row for row in told if not covers(row)]
    lines.append(f"valid or valid_wide: {len(told)}, of which {len(missed)} miss J: "
                 + ", ".join(str(row["seed"]) for row in missed))
    lines.append(f"false alarms: {len(alarms(rows))}: " + ", ".join(str(row["seed"]) for row in alarms(rows)))
    return "\n".join(lines)


def compared(rows: Sequence[dict[str, Any]], before: Sequence[dict[str, Any]]) -> tuple[str, int]:
    """How the intervals differ from another commit's; and how many are wider or gone."""
    old = {row["seed"]: row for row in before}
    both = [(row, old[row["seed"]]) for row in rows if row["seed"] in old]
    wider = [new["seed"] for new, was in both if None not in (new["low"], was["low"])
             and (new["high"] - new["low"]) > (was["high"] - was["low"]) * (1.0 + WIDER)]
    gone = [new["seed"] for new, was in both if new["low"] is None and was["low"] is not None]
    other = [new["seed"] for new, was in both if new["cause"] != was["cause"]]
    lines = [f"compared with {len(both)} runs: {len(wider)} intervals wider, {len(gone)} gone, "
             f"{len(other)} ended by another cause"]
    lines += [f"  {name}: {', '.join(map(str, seeds))}" for name, seeds in
              (("wider", wider), ("gone", gone), ("other cause", other)) if seeds]
    return "\n".join(lines), len(wider) + len(gone)


def show(row: dict[str, Any]) -> None:
    """Print a run."""
    print(line(row), flush=True)


def main() -> int:
    """Print a line for each run and the counts; 1 if there is a false alarm, or an interval wider than before."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=2000)
    parser.add_argument("--first", type=int, default=1, metavar="SEED")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--out", type=Path, help="the results as JSON lines; seeds that stand there are not run again")
    parser.add_argument("--against", type=Path, metavar="FILE", help="what --out wrote at another commit")
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument("--keep", type=Path, metavar="DIR", help="existing folder in which to keep the logs")
    kept.add_argument("--replay", type=Path, metavar="DIR", help="folder with kept logs, to identify them again")
    asked = parser.parse_args()
    seeds: Sequence[int] = range(asked.first, asked.first + asked.runs)
    if asked.replay is not None:
        seeds = [seed for seed in seeds if (asked.replay / f"{seed}.mcap").exists()]
        judged = partial(replay, logs=asked.replay)
    else:
        judged = partial(work, keep=asked.keep)
    rows = kept_rows(asked.out, "seed", seeds, judged, show, asked.jobs)
    rows = [row for row in rows if row["seed"] in seeds]
    print(summary(rows))
    worse = 0
    if asked.against is not None:
        before = [json.loads(text) for text in asked.against.read_text(encoding="utf-8").splitlines()]
        text, worse = compared(rows, before)
        print(text)
    return 1 if worse or alarms(rows) else 0


if __name__ == "__main__":
    sys.exit(main())
