"""`tdhil tune verify` on random rigs: typed gains agree, gains typed wrongly by 30 % are found.

    python benchmarks/speed_loop_verify.py --out rows.jsonl [--rigs 150] [--two-mass 150] [--first 1]

J, friction, lags of the reports, noise and lags of the speed loop are random. Each rig is recorded by a test bench that
shares no code with the estimator, identified, and tuned from the result: half of the rigs for the largest bandwidth,
the others for a part of it. The lags inside the speed loop are stated with a random error: ±10 % is their interval.

Then the simulated drive gets the tuned gains, and runs `tdhil tune verify` as a command. A second run has P, I or both
multiplied by 0.7 or 1.3. Each rig is one line of the file; rigs that the file has are skipped. Printed for each kind of
shaft: agreement with typed gains, wrong gains found by kind of error, and runs that cannot tell, with their share.

`--two-mass`: rigs of two masses on a coupling, beside the rigid ones: resonances of 3 to 20 Hz, above the excited
lines. The simulated drive itself is identified, J is that of both masses, and the requested bandwidth is within the
excited lines, as `tdhil tune speed` advises (TDH-055). A shaft that oscillates at some tenths of a hertz is a drill
string: speed steps are refused above one.

Required of each kind of shaft, by observed shares: at least 95 % of typed gains agree, and at least 90 % of wrong gains
are found, both of all runs, which is the proof, and of the runs that can tell. `tune speed` refuses at most 10 % of the
rigs. The exit code is 1 otherwise, also for a kind without a rig.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np

from benchmarks.kept_rows import kept_rows
from benchmarks.shares import met
from benchmarks.speed_loop_margins import MOST_REFUSED, drawn_rig, stated
from tdhil.cli.tune_speed import LoopLags, plant_of
from tdhil.estimation import identify
from tdhil.report import LoopTunedFor, loop_document, result_document
from tdhil.runner.excitation import RigGuess
from tdhil.speed_loop import LoopTuningRefused, Range, SpeedLoopCase, design_speed_loop
from tests.estimation import shaft_bench
from tests.estimation.planned_motions import planned

WRONG = {"P": (True, False), "I": (False, True), "P and I": (True, True)}
LEAST_AGREE, LEAST_FOUND = 0.95, 0.90     # of the runs of a kind of shaft; issue 29
CONTROL_PERIOD_S = 0.002
LEAST_LAG_S = 0.05         # of the reported speed and torque
COUPLING_RIG = {"load": "none", "limits": {"speed_min_rad_s": 0.5, "speed_max_rad_s": 10.0, "torque_nm": 400.0,
                                           "time_s": 900.0, "quick_stop_rad_s2": 1.0, "watchdog_s": 0.5,
                                           "probe_torque_nm": 200.0, "probe_travel_rad": 3.0}}
"""rig.yaml of two masses on a coupling: without it, the simulated rig has a drill string, and steps are refused. The
torque of the sign probe is that of the simulated rig without a rig.yaml: friction is up to 80 N·m, and the shaft has to
be accelerated."""
RESONANCES_HZ, LOAD_SHARES, DAMPING_RATIOS = (3.0, 20.0), (0.2, 0.5), (0.02, 0.1)
TWO_MASS = 100_000
"""Seeds from here on have a shaft of two masses."""


def rig_of(rng: np.random.Generator, seed: int) -> tuple[dict[str, Any], dict[str, Any], float]:
    """Return the simulated rig as a plant.yaml, the result of its identification, and the noise factor."""
    rig, noise = drawn_rig(rng, LEAST_LAG_S)
    motion, _ = planned(guess=RigGuess(rig.inertia, rig.viscous, rig.coulomb))
    recording = shaft_bench.simulate(rig, motion, [seed])[0]
    plant = {
        "plant": {"kind": "rigid", "inertia_kg_m2": rig.inertia, "viscous_nm_s_rad": rig.viscous,
                  "coulomb_nm": rig.coulomb},
        **simulated(rng, rig, noise),
    }
    return plant, result_document(identify(recording), recording, {}, ""), noise


def two_mass_rig_of(rng: np.random.Generator, seed: int) -> tuple[dict[str, Any], dict[str, Any], float]:
    """Return a simulated rig of two masses as a plant.yaml, the result of its identification, and the noise factor."""
    rig, noise = drawn_rig(rng, LEAST_LAG_S)
    share = rng.uniform(*LOAD_SHARES)
    swing_rad_s = 2.0 * math.pi * math.exp(rng.uniform(*map(math.log, RESONANCES_HZ)))
    between_kg_m2 = rig.inertia * share * (1.0 - share)      # J_r J_L/(J_r + J_L), which oscillates on the coupling
    plant = {
        "plant": {"kind": "two_mass", "inertia_kg_m2": (1.0 - share) * rig.inertia, "viscous_nm_s_rad": rig.viscous,
                  "coulomb_nm": rig.coulomb, "stiffness_nm_rad": between_kg_m2 * swing_rad_s**2,
                  "damping_nm_s_rad": 2.0 * rng.uniform(*DAMPING_RATIOS) * between_kg_m2 * swing_rad_s,
                  "bottom": {"inertia_kg_m2": share * rig.inertia, "viscous_nm_s_rad": 0.0, "coulomb_nm": 0.0}},
        **simulated(rng, rig, noise),
    }
    with tempfile.TemporaryDirectory() as name:
        document, _ = command(Path(name), plant, ["identify"], seed)
    return plant, document, noise


def simulated(rng: np.random.Generator, rig: shaft_bench.Rig, noise: float) -> dict[str, Any]:
    """Return drive, reports and noise of a plant.yaml."""
    return {
        "drive": {"speed_filter_s": rng.uniform(0.008, 0.04), "torque_lag_s": rng.uniform(0.004, 0.02),
                  "control_period_s": CONTROL_PERIOD_S},
        "reporting": {"speed_lag_s": rig.speed_poles[0], "torque_lag_s": rig.torque_poles[0]},
        "noise": {"speed_sensor_rad_s": noise * 0.02, "torque_nm": noise * 10.0, "load_nm": noise * 3.0},
    }


def command(folder: Path, plant: dict[str, Any], words: Sequence[str], seed: int) -> tuple[dict[str, Any], int]:
    """Return the JSON document and the exit code of a tdhil command with this simulated rig."""
    path, rig, log = folder / "plant.yaml", folder / "rig.yaml", folder / "run.mcap"
    path.write_text(json.dumps(plant), encoding="utf-8")                   # JSON is YAML
    rig.write_text(json.dumps(COUPLING_RIG), encoding="utf-8")
    more = ["--rig", str(rig)] if plant["plant"]["kind"] == "two_mass" else []
    log.unlink(missing_ok=True)
    done = subprocess.run(
        [sys.executable, "-m", "tdhil", *words, "--simulate", "--plant", str(path), "--seed", str(seed), "--log",
         str(log), "--json", *more], capture_output=True, text=True, check=False,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, timeout=900)
    return json.loads(done.stdout), done.returncode


def verified(plant: dict[str, Any], tuning: Path, seed: int, folder: Path) -> dict[str, Any]:
    """Return verdict and reason of one run of the command."""
    document, code = command(folder, plant, ["tune", "verify", str(tuning)], seed)
    if "verdict" not in document:
        return {"verdict": "ended", "reason": document["error"]["message"], "code": code}
    ratios = {row["name"]: [None if row["measured"][end] is None else row["measured"][end] / row["predicted"]["value"]
                            for end in ("value", "low", "high")] for row in document["rows"]}
    return {"verdict": document["verdict"], "reason": document["reason"], "code": code, "ratios": ratios,
            "misfit": document["misfit"]}


def judged(seed: int) -> dict[str, Any]:
    """Return what became of one rig."""
    rng = np.random.default_rng([seed, 55])
    two_mass = seed >= TWO_MASS
    plant, result, noise = (two_mass_rig_of if two_mass else rig_of)(rng, seed)
    drive = plant["drive"]
    row: dict[str, Any] = {"seed": seed, "noise": noise, "refused": None, "shaft": "two-mass" if two_mass else "rigid"}
    lags = (stated(rng, drive["speed_filter_s"]), stated(rng, drive["torque_lag_s"]))
    # The simulated drive applies the end value of its lags during the whole step, so that the hold of a step adds none.
    dead = Range(0.0, 0.0, 0.5 * CONTROL_PERIOD_S)
    if two_mass and result.get("inertia_kg_m2") is None:
        return row | {"refused": f"identify: {result.get('reason') or result['error']['message']}"}
    try:
        case = SpeedLoopCase(plant_of(result, LoopLags(lags, dead), Path("result")))
        design = design_speed_loop(case)
        if two_mass:
            excited_hz = max(float(line["hertz"]) for line in result["lines"])
            hertz = min(excited_hz, design.tuned.bandwidth_hz.value) * rng.uniform(0.5, 1.0)
            design = design_speed_loop(replace(case, bandwidth_hz=hertz))
        elif seed % 2 == 0:
            hertz = design.tuned.bandwidth_hz.value * rng.uniform(0.2, 0.8)
            design = design_speed_loop(replace(case, bandwidth_hz=hertz))
    except LoopTuningRefused as error:
        return row | {"refused": str(error)}
    lag = Range(*(float(result["speed_lag_s"][name]) for name in ("value", "low", "high")))
    document = loop_document(design, None, LoopTunedFor("result", True, result["model"], None, 1.0, "as stated",
                                                        reported_speed_lag_s=lag))
    gains = design.tuned.gains
    kind, factor = list(WRONG)[seed % 3], (0.7, 1.3)[(seed // 3) % 2]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tuning = folder / "tune.json"
        tuning.write_text(json.dumps(document), encoding="utf-8")
        runs = {}
        for run, by in (("typed", (1.0, 1.0)), ("wrong", tuple(factor if one else 1.0 for one in WRONG[kind]))):
            there = drive | {"speed_gain_nm_s_rad": by[0] * gains.gain_nm_s_rad,
                             "speed_integral_gain_nm_rad": by[1] * gains.integral_nm_rad}
            runs[run] = verified(plant | {"drive": there}, tuning, seed, folder)
    return row | {"bandwidth_hz": design.tuned.bandwidth_hz.value, "kind": kind, "factor": factor, **runs}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rigs", type=int, default=150, help="rigid ones")
    parser.add_argument("--two-mass", type=int, default=150, help="rigs of two masses")
    parser.add_argument("--first", type=int, default=1)
    asked = parser.parse_args()
    begun = time.monotonic()

    def show(row: dict[str, Any]) -> None:
        if not row["refused"]:
            print(f"    {row['seed']}: typed {row['typed']['verdict']}, {row['kind']} by {row['factor']} "
                  f"{row['wrong']['verdict']}, {time.monotonic() - begun:.0f} s", flush=True)

    seeds = [begin + number for begin, count in ((asked.first, asked.rigs), (TWO_MASS + asked.first, asked.two_mass))
             for number in range(count)]
    rows = kept_rows(asked.out, "seed", seeds, judged, show)
    return told(rows)


def told(rows: Sequence[dict[str, Any]]) -> int:
    """Print the shares of each kind of shaft. Return the exit code."""
    good = True
    for shaft in ("rigid", "two-mass"):
        own = [row for row in rows if row.get("shaft", "rigid") == shaft]
        some = [row for row in own if not row["refused"]]
        print(f"{shaft}: {len(own)} rigs")
        good &= met("refused by identify or tune speed", len(own) - len(some), len(own), most=MOST_REFUSED)
        for run, right, least in (("typed", "agrees", LEAST_AGREE), ("wrong", "differs", LEAST_FOUND)):
            verdicts = [row[run]["verdict"] for row in some]
            hits, open_ = verdicts.count(right), verdicts.count("cannot_tell")
            for of, count in (("all, the proof", len(some)), ("those that can tell", len(some) - open_)):
                good &= met(f"{run} gains {right}, of {of}", hits, count, least=least)
            print(f"    {run} gains: {open_} cannot_tell; {len(some) - hits - open_} another verdict or ended")
        for kind in WRONG:
            of_kind = [row["wrong"]["verdict"] for row in some if row["kind"] == kind]
            print(f"    {kind} wrong: {of_kind.count('differs')} of {len(of_kind)} found")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
