"""`tdhil tune verify` on random rigs: typed gains agree, gains typed wrongly by 30 % are found.

    python benchmarks/speed_loop_verify.py --out rows.jsonl [--rigs 300] [--first 1]

J, friction, lags of the reports, noise and lags of the speed loop are random. Each rig is recorded by a test bench that
shares no code with the estimator, identified, and tuned from the result: half of the rigs for the largest bandwidth,
the others for a part of it. The lags inside the speed loop are stated with a random error: ±10 % is their interval.

Then the simulated drive gets the tuned gains, and runs `tdhil tune verify` as a command. A second run has P, I or both
multiplied by 0.7 or 1.3. Each rig is one line of the file; rigs that the file has are skipped. Printed: agreement
with typed gains, wrong gains found, and both by kind of error. The exit code is 1 if less than 95 % agree or less than
90 % are found, beyond what chance allows (one-sided 99 %, Clopper and Pearson).
"""

from __future__ import annotations

import argparse
import json
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
from benchmarks.speed_loop_margins import stated, upper_bound
from tdhil.cli.tune_speed import plant_of
from tdhil.estimation import identify
from tdhil.report import LoopTunedFor, loop_document, result_document
from tdhil.runner.excitation import RigGuess
from tdhil.speed_loop import LoopTuningRefused, Range, SpeedLoopCase, design_speed_loop
from tests.estimation import shaft_bench
from tests.estimation.planned_motions import planned

WRONG = {"P": (True, False), "I": (False, True), "P and I": (True, True)}
LEAST_AGREE, LEAST_FOUND = 0.95, 0.90
CONTROL_PERIOD_S = 0.002


def rig_of(rng: np.random.Generator, seed: int) -> tuple[dict[str, Any], dict[str, Any], float]:
    """Return the simulated rig as a plant.yaml, the result of its identification, and the noise factor."""
    noise, usual = 2.0 ** rng.uniform(-1.0, 1.0), shaft_bench.Rig()
    rig = replace(
        usual, inertia=104.0 * rng.uniform(0.7, 1.4), viscous=rng.uniform(3.0, 16.0), coulomb=rng.uniform(30.0, 80.0),
        speed_poles=(rng.uniform(0.05, 0.5),), torque_poles=(rng.uniform(0.05, 0.3),),
        load_sd=noise * usual.load_sd, ripple_sd=noise * usual.ripple_sd, sensor_sd=noise * usual.sensor_sd)
    motion, _ = planned(guess=RigGuess(rig.inertia, rig.viscous, rig.coulomb))
    recording = shaft_bench.simulate(rig, motion, [seed])[0]
    plant = {
        "plant": {"kind": "rigid", "inertia_kg_m2": rig.inertia, "viscous_nm_s_rad": rig.viscous,
                  "coulomb_nm": rig.coulomb},
        "drive": {"speed_filter_s": rng.uniform(0.008, 0.04), "torque_lag_s": rng.uniform(0.004, 0.02),
                  "control_period_s": CONTROL_PERIOD_S},
        "reporting": {"speed_lag_s": rig.speed_poles[0], "torque_lag_s": rig.torque_poles[0]},
        "noise": {"speed_sensor_rad_s": noise * 0.02, "torque_nm": noise * 10.0, "load_nm": noise * 3.0},
    }
    return plant, result_document(identify(recording), recording, {}, ""), noise


def verified(plant: dict[str, Any], tuning: Path, seed: int, folder: Path) -> dict[str, Any]:
    """Return verdict and reason of one run of the command."""
    path = folder / "plant.yaml"
    path.write_text(json.dumps(plant), encoding="utf-8")                   # JSON is YAML
    (folder / "v.mcap").unlink(missing_ok=True)
    done = subprocess.run(
        [sys.executable, "-m", "tdhil", "tune", "verify", str(tuning), "--simulate", "--plant", str(path), "--seed",
         str(seed), "--log", str(folder / "v.mcap"), "--json"], capture_output=True, text=True, check=False,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"}, timeout=900)
    document = json.loads(done.stdout)
    if "verdict" not in document:
        return {"verdict": "ended", "reason": document["error"]["message"], "code": done.returncode}
    ratios = {row["name"]: [None if row["measured"][end] is None else row["measured"][end] / row["predicted"]["value"]
                            for end in ("value", "low", "high")] for row in document["rows"]}
    return {"verdict": document["verdict"], "reason": document["reason"], "code": done.returncode, "ratios": ratios,
            "misfit": document["misfit"]}


def judged(seed: int) -> dict[str, Any]:
    """Return what became of one rig."""
    rng = np.random.default_rng([seed, 55])
    plant, result, noise = rig_of(rng, seed)
    drive = plant["drive"]
    row: dict[str, Any] = {"seed": seed, "noise": noise, "refused": None}
    lags = (stated(rng, drive["speed_filter_s"]), stated(rng, drive["torque_lag_s"]))
    # A cycle of the control, held for one: from half of one to two.
    dead = Range(CONTROL_PERIOD_S, 0.5 * CONTROL_PERIOD_S, 2.0 * CONTROL_PERIOD_S)
    try:
        case = SpeedLoopCase(plant_of(result, lags, dead, Path("result")))
        design = design_speed_loop(case)
        if seed % 2 == 0:
            hertz = design.tuned.bandwidth_hz.value * rng.uniform(0.2, 0.8)
            design = design_speed_loop(replace(case, bandwidth_hz=hertz))
    except LoopTuningRefused as error:
        return row | {"refused": str(error)}
    lag = Range(*(float(result["speed_lag_s"][name]) for name in ("value", "low", "high")))
    document = loop_document(design, None, LoopTunedFor("result", True, "rigid", None, 1.0, "as stated",
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
    parser.add_argument("--rigs", type=int, default=300)
    parser.add_argument("--first", type=int, default=1)
    asked = parser.parse_args()
    begun = time.monotonic()

    def show(row: dict[str, Any]) -> None:
        if not row["refused"]:
            print(f"    {row['seed']}: typed {row['typed']['verdict']}, {row['kind']} by {row['factor']} "
                  f"{row['wrong']['verdict']}, {time.monotonic() - begun:.0f} s", flush=True)

    rows = kept_rows(asked.out, "seed", range(asked.first, asked.first + asked.rigs), judged, show)
    return told(rows)


def told(rows: Sequence[dict[str, Any]]) -> int:
    """Print the shares. Return the exit code."""
    some = [row for row in rows if not row["refused"]]
    if not some:
        return 1
    verdicts = [row["typed"]["verdict"] for row in some]
    agree, wide = verdicts.count("agrees"), verdicts.count("cannot_tell")
    decided = [row for row in some if row["typed"]["verdict"] != "cannot_tell"]
    found = [row for row in some if row["wrong"]["verdict"] == "differs"]
    print(f"{len(rows)} rigs, {len(rows) - len(some)} refused by tune speed; typed gains: {agree} agree, {wide} cannot "
          f"tell, {len(some) - agree - wide} differ or ended; wrong gains: {len(found)} of {len(some)} found")
    for kind in WRONG:
        of = [row for row in some if row["kind"] == kind]
        print(f"    {kind} wrong: {sum(row in found for row in of)} of {len(of)} found")
    kept = upper_bound(agree, len(decided)) >= LEAST_AGREE if decided else False
    return 0 if kept and upper_bound(len(found), len(some)) >= LEAST_FOUND else 1


if __name__ == "__main__":
    sys.exit(main())
