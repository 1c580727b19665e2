"""SIGKILL at random moments of all five stages, the simulated drive in a process of its own behind a socketcand hub.

    python benchmarks/kill_at_random.py                      # fifty of them; 1 if any of them fails
    python benchmarks/kill_at_random.py --runs 3 --seed 7    # other moments
    python benchmarks/kill_at_random.py --first 17 --runs 1  # that one again

Every trial draws its cycle rate, the plant's seed, and a moment: a stage (in turn) and a place in it, in plant time.
Most are stepped; every tenth (--real-time N: so many of them) runs against the wall clock, which reaches no further
than stages 1 and 2. What each must do:

- at rest: by the simulator's own trace the shaft stands still within the watchdog time + one cycle after the last
  frame, + the quick stop's ramp from the speed it then has, + 5·J/K_p that the drive's speed loop trails behind its
  ramp; it stays at rest, and it was never let go while it turned. Plant time throughout.
- log: `tdhil replay` ends with 3 or 9, `tdhil recover` with 3, neither with a traceback; and the samples missing at
  its end are worth at most half a second. Stepped: of control time, from the last sample in the log to the plant's
  time at the host's last frame. Real time: of wall time, from the last sample's log time to the kill, plus one cycle.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from random import Random

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from tests.path.path_runs import (  # noqa: E402
    INERTIA,
    PLAIN,
    QUICK_STOP_RAD_S2,
    SETTLING_S,
    STAGES,
    TORQUE_NM,
    WATCHDOG_S,
    Shaft,
    host,
    peer,
    tail_time,
    tdhil,
    wait_for,
)

LASTS_S = {"setup": 3.5, "speed": 28.0, "torque": 8.5, "hold": 13.0, "acquire": 60.0}
"""About how long each stage takes, in plant time; stage 5 is made longer than any moment drawn (--periods 40)."""
RATES_HZ = (50.0, 100.0, 250.0)
MISSING_S = 0.5
BACK_RAD_S = 0.1
"""How far back the drive's own speed loop may swing at the end of its ramp. From 7.15 rad/s it was 0.046 to 0.054, from
3 rad/s 0.03 (eight kills at 50 Hz). Without friction this loop (J 104, P 300, I 300) swings back by 0.48."""
TRIES = 5
REAL_RATE_HZ, REAL_WATCHDOG_S = 20.0, 2.0       # what a loaded machine still keeps
REAL_LASTS_S = {"setup": 3.5, "speed": 12.0}
REAL_RIG = f"""\
rate_hz: {REAL_RATE_HZ}
limits: {{speed_min_rad_s: 0.5, speed_max_rad_s: 10.0, torque_nm: {TORQUE_NM}, time_s: 900.0,
  quick_stop_rad_s2: {QUICK_STOP_RAD_S2}, watchdog_s: {REAL_WATCHDOG_S}, probe_torque_nm: 200.0, probe_travel_rad: 3.0}}
"""


@dataclass(frozen=True)
class Plan:
    """When a trial's host is killed: ``place_s`` of plant time into ``stage``, and ``wait_s`` of wall time more."""

    number: int
    real_time: bool
    stage: str
    place_s: float
    wait_s: float
    rate_hz: float
    plant_seed: int

    @property
    def watchdog_s(self) -> float:
        return REAL_WATCHDOG_S if self.real_time else WATCHDOG_S


@dataclass
class Outcome:
    """Result of a trial. Times in s of plant time, ``missing_s`` as in the module's text, ``took_s`` of wall time."""

    plan: Plan
    wrong: list[str]
    stage: str = "-"
    speed_rad_s: float = 0.0
    lost_s: float = 0.0            # from the host's last frame to the drive's reaction
    rest_s: float = 0.0            # from the host's last frame to standstill
    allowed_s: float = 0.0
    missing_s: float = 0.0
    replay: int = -1
    recover: int = -1
    took_s: float = 0.0


def plan_of(number: int, seed: int, real_time: bool) -> Plan:
    rng = Random(f"{seed} {number}")
    lasts = REAL_LASTS_S if real_time else LASTS_S
    stage = tuple(lasts)[number % len(lasts)]
    rate_hz = REAL_RATE_HZ if real_time else rng.choice(RATES_HZ)
    place_s = rng.uniform(0.0, lasts[stage])
    wait_s = rng.uniform(0.0, 0.02 if stage == "setup" else 0.3)       # a stepped setup takes less than a second
    return Plan(number, real_time, stage, place_s, wait_s, rate_hz, rng.randrange(2**31))


def trial(plan: Plan, folder: Path) -> Outcome:
    """One run that is killed. Where it ended before its moment came it is begun again."""
    began_s = time.monotonic()
    for attempt in range(TRIES):
        place = folder / f"{plan.number}_{attempt}"
        place.mkdir(parents=True)
        found = _try(plan, place)
        if found is not None:
            found.took_s = time.monotonic() - began_s
            return found
    return Outcome(plan, [f"{TRIES} runs ended before they could be killed"])


def _try(plan: Plan, folder: Path) -> Outcome | None:
    rig = folder / "rig.yaml"
    rig.write_text(REAL_RIG)
    clock = () if plan.real_time else ("--stepped",)
    speed = ("--rig", rig) if plan.real_time else ("--rate", plan.rate_hz)
    with peer(folder, *clock, "--seed", plan.plant_seed, program=PLAIN) as drive, host(
        folder, *drive.options, *clock, *speed, "--periods", 40
    ) as running:
        if not running.wait_for_line(f"stage {plan.stage} …"):
            return None
        due_s = tail_time(drive.trace) + plan.place_s
        if not wait_for("the moment", lambda: tail_time(drive.trace) >= due_s, running.child):
            return None
        time.sleep(plan.wait_s)
        killed_ns = time.time_ns()
        running.signal(signal.SIGKILL)
        done = running.finish()
        if done.code != -signal.SIGKILL:
            return None
        wait_for("the end of the stop", lambda: _over(drive.trace))
        found = Outcome(plan, [])
        _check_shaft(found, drive.shaft)
    _check_log(found, done.log, drive.shaft, killed_ns)
    return found


def _over(trace: Path) -> bool:
    """Nothing of the host's acts any more and the shaft has stood still for more than a second."""
    time.sleep(0.2)                        # a trace is a long read
    shaft = Shaft.read(trace)
    if "operation enabled" not in shaft.state:
        return shaft.time_s[-1] > 0.0 or not shaft.events("SYNC")
    lost = shaft.events("host heartbeat lost")
    return bool(lost) and shaft.at_rest_from() >= 0.0 and shaft.time_s[-1] > max(shaft.at_rest_from(), lost[0]) + 1.5


def _check_shaft(found: Outcome, shaft: Shaft) -> None:
    plan, wrong = found.plan, found.wrong
    if "operation enabled" not in shaft.state:
        if len(shaft.time_s) and abs(shaft.speed_rad_s).max() > 0.0:
            wrong.append("the shaft turned without having been enabled")
        return
    lost_s = shaft.events("host heartbeat lost")[-1]
    silent_s = _silent_from(shaft) or lost_s - plan.watchdog_s        # in real time the last frame is not recorded
    found.speed_rad_s = shaft.speed_at(silent_s)
    found.lost_s = lost_s - silent_s
    found.rest_s = max(0.0, shaft.at_rest_from() - silent_s)
    braking_s = shaft.speed_at(lost_s) / QUICK_STOP_RAD_S2 + SETTLING_S
    found.allowed_s = plan.watchdog_s + 1.0 / plan.rate_hz + braking_s
    if found.lost_s > plan.watchdog_s + 1.0 / plan.rate_hz:
        wrong.append(f"the watchdog took {found.lost_s:.3f} s")
    if found.rest_s > found.allowed_s:
        wrong.append(f"at rest after {found.rest_s:.2f} s, allowed are {found.allowed_s:.2f} s")
    after = shaft.time_s >= silent_s
    fastest = found.speed_rad_s + plan.watchdog_s * TORQUE_NM / INERTIA
    if shaft.speed_rad_s[after].max() > fastest or shaft.speed_rad_s[after].min() < -BACK_RAD_S:
        wrong.append("the shaft went faster or further back than the last setpoint can make it go")
    try:
        shaft.assert_at_rest()
    except AssertionError as error:
        wrong.append(str(error) or "not at rest")
    if shaft.state[-1] != "quick stop active":
        wrong.append(f"it ended in {shaft.state[-1]!r}")


def _check_log(found: Outcome, log: Path | None, shaft: Shaft, killed_ns: int) -> None:
    from tdhil.errors import NothingRecoverable
    from tdhil.recording.log_reader import read_run

    assert log is not None
    plan, wrong = found.plan, found.wrong
    try:
        run = read_run(log)
        logged_s = float(run.recording.time_s[-1]) if len(run.recording.time_s) else 0.0
        found.stage = _stage_at_the_end(run.stages)
        if run.complete:
            wrong.append("a killed run's log calls itself whole")
    except NothingRecoverable:
        logged_s, found.stage = 0.0, "setup"
    if plan.real_time:
        last_ns = last_sample_ns(log)
        found.missing_s = (killed_ns - last_ns) * 1e-9 if last_ns else 0.0
    else:
        found.missing_s = (_silent_from(shaft) or 0.0) - logged_s
    allowed_s = MISSING_S + (1.0 / plan.rate_hz if plan.real_time else 0.0)
    if found.missing_s > allowed_s:
        wrong.append(f"{found.missing_s:.2f} s are missing from the log's end")
    replayed, recovered = tdhil("replay", "--json", log), tdhil("recover", "--json", log)
    found.replay, found.recover = replayed.code, recovered.code
    empty = logged_s == 0.0
    if replayed.code not in ((3, 9, 10) if empty else (3, 9)):
        wrong.append(f"replay ended with {replayed.code}: {replayed.err.strip()[:200]}")
    if recovered.code not in ((3, 10) if empty else (3,)):
        wrong.append(f"recover ended with {recovered.code}: {recovered.err.strip()[:200]}")
    if "Traceback" in replayed.err + recovered.err:
        wrong.append("a traceback reached the user")


def _silent_from(shaft: Shaft) -> float | None:
    """Plant time at the host's last frame, where time is stepped. (Silent for a while it may have been before.)"""
    return max(shaft.events("running on in own time"), default=None)


def _stage_at_the_end(stages: tuple) -> str:
    """The stage that was under way: the first one without an outcome in the log."""
    known = [stage.name for stage in stages]
    return next((name for name in STAGES if name not in known), "after acquire")


def last_sample_ns(log: Path) -> int:
    """Log time of the last sample, read by the mcap package itself."""
    from mcap.exceptions import EndOfFile, McapError
    from mcap.reader import NonSeekingReader

    last_ns = 0
    with log.open("rb") as file:
        try:
            for _, _, message in NonSeekingReader(file).iter_messages(topics=["/sample"], log_time_order=False):
                last_ns = message.log_time
        except (EndOfFile, McapError):
            pass
    return last_ns


HEAD = (f"{'#':>3} {'clock':<7} {'rate':>4} {'stage':<8} {'speed':>6} {'watchdog':>8} {'at rest':>8} {'allowed':>8}"
        f" {'missing':>8} {'replay':>6} {'recover':>7} {'wall':>5}")


def row(found: Outcome) -> str:
    plan = found.plan
    verdict = "" if not found.wrong else "  FAILED: " + "; ".join(found.wrong)
    return (f"{plan.number:>3} {'real' if plan.real_time else 'stepped':<7} {plan.rate_hz:>4.0f} {found.stage:<8}"
            f" {found.speed_rad_s:>6.2f} {found.lost_s:>8.3f} {found.rest_s:>8.3f} {found.allowed_s:>8.3f}"
            f" {found.missing_s:>8.3f} {found.replay:>6} {found.recover:>7} {found.took_s:>5.0f}{verdict}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=50, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--real-time", type=int, metavar="N", help="how many against the wall clock (default: a tenth)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="how many at a time (default 2)")
    wish = parser.parse_args()
    real = wish.runs // 10 if wish.real_time is None else wish.real_time
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        del os.environ[name]
    numbers = range(wish.first, wish.first + wish.runs)
    plans = [plan_of(number, wish.seed, number - wish.first >= wish.runs - real) for number in numbers]
    print("times in s (plant time; missing: control time where stepped, wall time where real), speed in rad/s")
    print(HEAD, flush=True)
    done = []
    with tempfile.TemporaryDirectory(prefix="kill-") as folder, ProcessPoolExecutor(wish.jobs) as pool:
        os.environ["HOME"] = folder            # no bus of the user's own files
        for found in pool.map(trial, plans, repeat(Path(folder))):
            done.append(found)
            print(row(found), flush=True)
    failed = sum(bool(found.wrong) for found in done)
    moved = [found for found in done if found.allowed_s]
    print(f"{len(done)} killed, {failed} failed; {len(moved)} of them enabled; slowest watchdog"
          f" {max((found.lost_s for found in moved), default=0.0):.3f} s, longest to rest"
          f" {max((found.rest_s for found in moved), default=0.0):.2f} s, most of its bound used"
          f" {max((found.rest_s / found.allowed_s for found in moved), default=0.0):.0%}, most missing"
          f" {max((found.missing_s for found in done), default=0.0):.3f} s")
    counts = {stage: sum(found.stage == stage for found in done) for stage in STAGES}
    print("by the stage under way: " + ", ".join(f"{stage} {count}" for stage, count in counts.items()))
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
