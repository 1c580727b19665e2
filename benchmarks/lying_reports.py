"""Runs whose drive lies, through the real path with the embedded simulator in stepped time, against the true shaft.

    python benchmarks/lying_reports.py --all [--jobs 2] [--out lying.jsonl]
    python benchmarks/lying_reports.py --sample 50 --seed 25 [--list]
    python benchmarks/lying_reports.py --number 4711 [--keep DIR]

`sim_bus/lying_runs.py` has the combinations (signal × distortion × value × where × moment × rig, bus and program),
`sim_bus/shaft_judge.py` the five rules. `--all` is every lie at every moment, with the programs taking turns. Every run
has a seed and repeats to the last frame. What physics cannot tell is listed with its reason and not asked for.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

from benchmarks.called_here import called_here  # noqa: E402
from benchmarks.kept_rows import kept_rows  # noqa: E402
from sim_bus.lying_runs import UNKNOWABLE, Combination, product, sample, standard, unknowable  # noqa: E402
from sim_bus.shaft_judge import REACTION_S, JudgedMachine, judge, outcome_of, read_shaft  # noqa: E402

RULES = {
    "a": "disabled while it turned", "b": "reported at rest while it turned", "c": "a valid interval misses J",
    "d": "faster than limit and reaction time allow", "e": "no known end, or a log that is not closed",
}


def closed(log: Path) -> bool:
    """The log is there, whole and finished."""
    from tdhil.errors import LogError
    from tdhil.recording import read_run

    try:
        return read_run(log).complete
    except (LogError, OSError):
        return False


def run(combination: Combination, folder: Path, reaction_s: float) -> dict[str, Any]:
    """One run in this process, judged."""
    for name, text in combination.program.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    log, trace = folder / "run.mcap", folder / "shaft.csv"
    arguments = [*combination.arguments(str(folder)), "--json", "--log", str(log), "--trace", str(trace)]
    here = called_here(arguments)
    document, said = here.document, here.said
    outcome = outcome_of(here.code, document, said, log_closed=closed(log))
    program, excuse = combination.program, unknowable(combination)
    machine = JudgedMachine(program.inertia_kg_m2, program.coulomb_nm, combination.largest_torque_nm,
                            program.speed_max_rad_s, program.string)
    judged = judge(read_shaft(trace), outcome, machine, not_asked=excuse.rules if excuse else frozenset(),
                   scale_change=combination.scale_change, reaction_s=reaction_s)
    return {
        "number": combination.number, "program": program.name, "fault": combination.fault, "where": combination.where,
        "moment": combination.moment or "start", "early_stop": combination.ends_early, "seed": combination.seed,
        "exit_code": here.code, "verdict": outcome.verdict, "message": outcome.message[:300],
        "cause": (document.get("error") or {}).get("kind"), "reached": "never came" not in said,
        "fastest_rad_s": round(judged.fastest_rad_s, 3), "reaction_s": round(judged.reaction_s, 3),
        "broken": dict(judged.broken), "excused": dict(judged.excused), "took_s": round(here.took_s, 2),
    }


def work(number: int, reaction_s: float, keep: str | None) -> dict[str, Any]:
    """One number of `product`, in a folder of its own."""
    combination = product()[number]
    if keep is not None:
        folder = Path(keep) / str(number)
        folder.mkdir(parents=True, exist_ok=True)
        return run(combination, folder, reaction_s)
    with tempfile.TemporaryDirectory() as folder_name:
        return run(combination, Path(folder_name), reaction_s)


def line(row: dict[str, Any]) -> str:
    """A run in a line."""
    broken = "; ".join(f"{rule}: {text}" for rule, text in row["broken"].items())
    excused = "; ".join(f"({rule}: {text})" for rule, text in row["excused"].items())
    what = f"{row['fault']}{' +emcy' if row['early_stop'] else ''}{'' if row['reached'] else ' (never came)'}"
    end = row["verdict"] or row["cause"] or ""
    return (f"{row['number']:>5} {row['program']:<29}{what:<34} exit {row['exit_code']:>3} {end:<18} "
            f"{row['fastest_rad_s']:6.2f} rad/s {row['took_s']:4.1f} s  {broken}{excused}")


def show(row: dict[str, Any]) -> None:
    """Print a run."""
    print(line(row), flush=True)


def summary(rows: Sequence[dict[str, Any]]) -> str:
    """Counts by rule, by where, by moment and by program."""
    broken = [row for row in rows if row["broken"]]
    lines = ["", f"{len(rows)} runs, {len(broken)} break a rule, "
             f"{sum(not row['reached'] for row in rows)} ended before their lie began, "
             f"{sum(row['took_s'] for row in rows):.0f} s of processor time"]
    for rule, text in RULES.items():
        mine = [row for row in rows if rule in row["broken"]]
        lines.append(f"  {rule}  {text:<48}{len(mine):>4}")
        if mine:
            for key in ("where", "moment", "program"):
                counts = Counter(row[key] for row in mine).most_common()
                lines.append("       " + ", ".join(f"{name} {count}" for name, count in counts))
    used = [row["reaction_s"] for row in rows if "d" not in row["excused"]]
    lines.append(f"reaction time used at most: {max(used, default=0.0):.2f} s")
    codes = Counter(row["exit_code"] for row in rows)
    lines.append("exits: " + ", ".join(f"{code}: {count}" for code, count in sorted(codes.items())))
    lines.append("what the reports cannot show:")
    for one in UNKNOWABLE:
        rules = ", ".join(sorted(one.unknowable.rules))
        lines.append(f"  {one.words}: {one.unknowable.reason} (not asked: {rules})")
    return "\n".join(lines)


def main() -> int:
    """Print a line for each run and the counts; 1 if a rule is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--all", action="store_true", help="every lie at every moment once")
    which.add_argument("--sample", type=int, metavar="N", help="a seeded part of all combinations")
    which.add_argument("--number", type=int, nargs="+", help="these combinations")
    parser.add_argument("--seed", type=int, default=25, help="of the sample (25)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (1)")
    parser.add_argument("--reaction", type=float, default=REACTION_S, metavar="S", help="reaction time of rule d (1 s)")
    parser.add_argument("--keep", help="folder to keep logs and traces in")
    parser.add_argument("--out", type=Path, help="results as JSON lines; numbers that stand there are not run again")
    parser.add_argument("--list", action="store_true", help="only say what would be run")
    asked = parser.parse_args()
    if asked.all:
        chosen = list(standard())
    elif asked.sample is not None:
        chosen = sample(asked.sample, asked.seed)
    else:
        chosen = [product()[number] for number in asked.number]
    if asked.list:
        print("\n".join(map(str, chosen)))
        return 0
    numbers = {one.number for one in chosen}
    rows = kept_rows(asked.out, "number", [one.number for one in chosen],
                     partial(work, reaction_s=asked.reaction, keep=asked.keep), show, asked.jobs)
    rows = [row for row in rows if row["number"] in numbers]
    print(summary(rows))
    return 1 if any(row["broken"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
