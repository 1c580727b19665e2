"""Acceptance on the simulator, changed in one thing at a time: how often it is named right, and the false alarms.

``python benchmarks/acceptance.py --runs 500`` runs as expected, then each change ``--changed`` times, in stepped time.
Wanted: what is off named right in 95 %, false alarms at most 1 %.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

PLANT = """plant: {{inertia_kg_m2: {inertia}, viscous_nm_s_rad: {viscous}, coulomb_nm: {coulomb}}}
reporting: {{speed_lag_s: {speed_lag}, torque_scale: {scale}}}
"""
USUAL = {"inertia": 104.0, "viscous": 8.0, "coulomb": 60.0, "speed_lag": 0.4, "scale": 1.0}
EXPECT = ("inertia=104±15%", "coulomb=60±12", "speed-lag=400ms±120ms")
CHANGES = {
    "inertia": ("moment of inertia", {"inertia": 150.0}), "coulomb": ("Coulomb friction", {"coulomb": 100.0}),
    "speed filter": ("lag of the reported speed", {"speed_lag": 0.8}),
}


def one(folder, seed, values):
    """Result of a run: its verdict, and what is off."""
    plant = folder / f"{seed}.yaml"
    plant.write_text(PLANT.format(**(USUAL | values)), encoding="utf-8")
    command = [sys.executable, "-m", "tdhil", "identify", "--simulate", "--seed", str(seed), "--rate", "50", "--json",
               "--plant", str(plant), "--log", str(folder / f"{seed}.mcap")]
    for text in EXPECT:
        command += ["--expect", text]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (folder / f"{seed}.mcap").unlink(missing_ok=True)
    found = json.loads(done.stdout).get("acceptance")       # a run that ended early has none
    return ("no result", []) if found is None else (found["verdict"], found["off"])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=500)
    parser.add_argument("--changed", type=int, default=100)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(os.cpu_count()) as pool:
        folder = Path(name)
        said = list(pool.map(lambda seed: one(folder, seed, {}), range(asked.runs)))
        alarms = sum(verdict == "fail" for verdict, _ in said)
        print(f"as expected: {alarms} false alarms of {asked.runs}, "
              f"{sum(verdict == 'pass' for verdict, _ in said)} pass")
        for k, (what, (words, values)) in enumerate(CHANGES.items(), start=1):
            first = 100_000 * k
            said = list(pool.map(lambda seed, values=values: one(folder, seed, values),
                                 range(first, first + asked.changed)))
            right = sum(len(off) == 1 and words in off[0] for _, off in said)
            print(f"{what}: named right in {right} of {asked.changed}, "
                  f"{sum(verdict == 'no result' for verdict, _ in said)} without a result")


if __name__ == "__main__":
    main()
