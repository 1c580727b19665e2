"""Whole runs on shafts that swing: the shipped two-mass and string examples, the string with its pipe known, and a bit
on bottom that turns steadily, without and with 500 N·m of noise; how many are answered, how far off, how many covered,
how wide.

    python benchmarks/string_runs.py [--seeds 50] [--first 1] [--cases two-mass string pipe loaded bit prbs bit-prbs]

`prbs` and `bit-prbs` are `loaded` and `bit` with pseudo-random torque, told before the echo.

Every run is one `tdhil identify --simulate` over the CANopen path in stepped time, 20 to 40 s of processor time; one
after the other, so that it can run beside other work.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
TRUE_KG_M2 = 1500.0

STRING = "make_up_torque_nm: 8000\ntorque_ramp_nm_s: 100\n"
PIPE = "load: {kind: string, length_m: 2300, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}\n"
ON_BOTTOM = """\
load: {kind: string, length_m: 2300, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}
make_up_torque_nm: 30000
torque_ramp_nm_s: 400
limits:
  speed_min_rad_s: 15
  speed_max_rad_s: 26
  torque_nm: 15000
  time_s: 1800
  quick_stop_rad_s2: 1.0
  probe_torque_nm: 8000
  probe_travel_rad: 12
"""
CASES = {
    "two-mass": ("plant_two_mass.yaml", ""),
    "string": ("plant_string.yaml", ""),
    "pipe": ("plant_string.yaml", PIPE + STRING),
    "loaded": ("plant_stick_slip.yaml", ON_BOTTOM),
    "bit": ("plant_stick_slip.yaml", ON_BOTTOM),
    "prbs": ("plant_stick_slip.yaml", ON_BOTTOM),
    "bit-prbs": ("plant_stick_slip.yaml", ON_BOTTOM),
}
BIT_NOISE = "noise: {bottom_load_nm: 500.0}\n"
"""Random load of the bit in the cases `bit` and `bit-prbs`."""


@dataclass
class Tally:
    """Counts of one case."""

    runs: int = 0
    errors: list[float] = field(default_factory=list)
    halves: list[float] = field(default_factory=list)
    covered: int = 0

    def add(self, document: dict[str, Any]) -> None:
        """One run, answered or not."""
        self.runs += 1
        inertia = document.get("inertia_kg_m2")
        if inertia is None:
            return
        self.errors.append(inertia["value"] / TRUE_KG_M2 - 1.0)
        self.halves.append(0.5 * (inertia["high"] - inertia["low"]) / inertia["value"])
        self.covered += inertia["low"] <= TRUE_KG_M2 <= inertia["high"]

    def __str__(self) -> str:
        found = len(self.errors)
        if not found:
            return f"answered 0 of {self.runs}"
        mean, rms = sum(self.errors) / found, (sum(error**2 for error in self.errors) / found) ** 0.5
        return (
            f"answered {found} of {self.runs}, covered {self.covered}, mean error {100 * mean:+.2f} %, rms"
            f" {100 * rms:.2f} %, half-width {100 * median(self.halves):.2f} % (median), {100 * max(self.halves):.2f} %"
            " (most)"
        )


def run(case: str, seed: int, keep: Path | None) -> dict[str, Any]:
    """One run's document, with its exit code."""
    plant, rig = CASES[case]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tdhil", "identify", "--simulate", "--json", "--seed", str(seed),
                   "--plant", str(EXAMPLES / plant)]
        if case.endswith("prbs"):
            command += ["--excitation", "prbs"]
        if case.startswith("bit"):
            noisy = Path(folder) / "plant.yaml"
            noisy.write_text((EXAMPLES / plant).read_text(encoding="utf-8") + BIT_NOISE, encoding="utf-8")
            command[command.index("--plant") + 1] = str(noisy)
        if rig:
            path = Path(folder) / "rig.yaml"
            path.write_text(rig, encoding="utf-8")
            command += ["--rig", str(path)]
        log = (keep or Path(folder)) / f"{case}_{seed}.mcap"
        done = subprocess.run([*command, "--log", str(log)], capture_output=True, text=True, check=False)
    document: dict[str, Any] = json.loads(done.stdout) if done.stdout else {"error": {"message": done.stderr[-300:]}}
    return document | {"exit_code": done.returncode}


def told(document: dict[str, Any]) -> str:
    """A run in a line."""
    inertia = document.get("inertia_kg_m2")
    if inertia is None:
        error = document.get("error") or {}
        return f"exit {document['exit_code']}: {document.get('reason') or error.get('message')}"
    covers = "" if inertia["low"] <= TRUE_KG_M2 <= inertia["high"] else "  MISSES"
    half = 50.0 * (inertia["high"] - inertia["low"]) / inertia["value"]
    return (f"{inertia['value']:7.1f} ({inertia['low']:.0f} to {inertia['high']:.0f}) ±{half:.1f} %"
            f" {document['verdict']} {document['model']}{covers}")


def main() -> int:
    """Prints each run, and a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=50, help="how many")
    parser.add_argument("--first", type=int, default=1, help="the first one")
    parser.add_argument("--cases", nargs="+", choices=tuple(CASES), default=list(CASES))
    parser.add_argument("--keep", type=Path, help="folder to keep the logs in, for replays")
    asked = parser.parse_args()
    tallies = {case: Tally() for case in asked.cases}
    for seed in range(asked.first, asked.first + asked.seeds):
        for case, tally in tallies.items():
            document = run(case, seed, asked.keep)
            tally.add(document)
            print(f"{case:>8} {seed:>4} {told(document)}", flush=True)
    for case, tally in tallies.items():
        print(f"{case:>8}: {tally}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
