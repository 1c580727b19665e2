"""How often the interval covers the inertia of the default simulated rig over Modbus, with the line's real timing.

    python benchmarks/modbus_coverage.py [--seeds 20] [--first 1] [--rows "RTU 19200"] [--speed-only]

Every seed is a whole run of five stages in stepped time, through the driver's registers and the simulated drive's, with
every request and reply taking the time that it takes on the line. A row is a line at a rate; of each, the misses of the
95 % interval with the exact (Clopper-Pearson) 99 % bounds of the miss rate, the mean error, its standard deviation, and
the median half-width. A row fails if the lower bound is above 5 %. ``--speed-only``: the drive has no torque mode.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median, stdev

from drivers.clock import SteppedClock
from drivers.drive import Command, Preflight, Sample
from drivers.modbus.drive import ModbusDrive
from drivers.modbus.link import EmbeddedLink
from profiles.library import load_modbus_profile
from profiles.modbus import ModbusProfile
from sim_bus.modbus.embedded import EmbeddedModbusDrive, LineTiming
from sim_bus.params import RigParams
from tdhil.estimation import identify
from tdhil.estimation.result import Options
from tdhil.recording.log_writer import RunWriter
from tdhil.recording.recording import Recording, Stage
from tdhil.recording.run_log import RunLog
from tdhil.runner.five_stages import Runner
from tdhil.runner.settings import ExcitationRequest, MachineLimits, StopRequest
from tdhil.runner.task import Task

TRUE_KG_M2 = 104.0
LIMITS = MachineLimits(
    speed_min_rad_s=0.5, speed_max_rad_s=10.0, torque_nm=400.0, time_s=900.0, quick_stop_rad_s2=2.0,
    probe_torque_nm=200.0,
)
AS_FAST_AS_IT_GOES_HZ = 1000.0


@dataclass(frozen=True)
class Row:
    """A line, the rate asked for on it, and whether the drive has function 23."""

    name: str
    timing: LineTiming
    rate_hz: float
    function_23: bool


ROWS = (
    Row("RTU 19200, 10 Hz", LineTiming.rtu(19200, 0.005), 10.0, function_23=False),
    Row("RTU 19200, 18 Hz", LineTiming.rtu(19200, 0.005), 18.0, function_23=False),
    Row("RTU 115200, 20 Hz", LineTiming.rtu(115200, 0.010), 20.0, function_23=False),
    Row("RTU 115200, 30 Hz", LineTiming.rtu(115200, 0.010), 30.0, function_23=False),
    Row("RTU 19200, function 23", LineTiming.rtu(19200, 0.005), AS_FAST_AS_IT_GOES_HZ, function_23=True),
    Row("RTU 115200, function 23", LineTiming.rtu(115200, 0.010), AS_FAST_AS_IT_GOES_HZ, function_23=True),
    Row("TCP, 100 Hz", LineTiming.tcp(0.002), 100.0, function_23=True),
)


class Silent:
    """A display that shows nothing."""

    def preflight(self, preflight: Preflight) -> None: ...

    def stage_started(self, name: str, expected_s: float) -> None: ...

    def cycle(self, command: Command, sample: Sample) -> None: ...

    def planned(self, plan: object) -> None: ...

    def stage_ended(self, stage: Stage) -> None: ...

    def stopped(self, confirmed: bool) -> None: ...


def profile_of(row: Row, *, speed_only: bool) -> ModbusProfile:
    """The generic map, with the row's functions."""
    profile = load_modbus_profile("generic/modbus")
    functions = profile.cycle.functions if row.function_23 else tuple(f for f in profile.cycle.functions if f != 23)
    cycle = profile.cycle.model_copy(update={"functions": functions})
    modes = profile.modes.model_copy(update={"torque": False}) if speed_only else profile.modes
    return profile.model_copy(update={"cycle": cycle, "modes": modes})


def run(row: Row, seed: int, folder: Path, *, speed_only: bool) -> tuple[Recording, float]:
    """One seed: its recording, and the rate that the line carried, Hz. Raises what ended the run."""
    profile, clock = profile_of(row, speed_only=speed_only), SteppedClock()
    with EmbeddedModbusDrive(RigParams(), profile, seed=seed, timing=row.timing) as peer:
        drive = ModbusDrive(
            EmbeddedLink(peer.serve, clock), profile, unit=peer.unit, rate_hz=row.rate_hz, given=dict(peer.untold),
        )
        log = RunLog(RunWriter(folder / "run.mcap", epoch_ns=0, block=True), {})
        task = Task(LIMITS, ExcitationRequest(), {"torque_scale_rel_sd": 0.02})
        outcome = Runner(drive, lambda _: task, log, StopRequest(), Silent(), lambda *_: None).run()
        log.close()
    if outcome.cause is not None:
        raise outcome.cause
    assert outcome.stop is not None and outcome.stop.confirmed
    return log.recording(complete=True), 1.0 / drive.period_s


def bounds(misses: int, count: int) -> tuple[float, float]:
    """Clopper and Pearson's, 99 % either side."""
    from scipy.stats import beta

    low = 0.0 if misses == 0 else float(beta.ppf(0.01, misses, count - misses + 1))
    high = 1.0 if misses == count else float(beta.ppf(0.99, misses + 1, count - misses))
    return low, high


def measure(row: Row, seeds: range, *, speed_only: bool) -> bool:
    """Prints one row; False if too many intervals miss, or a run ended in trouble."""
    begun_s = time.monotonic()
    errors, halves, misses, troubles, rate_hz = [], [], 0, [], float("nan")
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            try:
                recording, rate_hz = run(row, seed, Path(folder), speed_only=speed_only)
            except Exception as error:
                troubles.append(f"seed {seed}: {type(error).__name__}: {error}")
                continue
        found = identify(recording, Options(tolerance=0.05))
        if found.inertia is None:
            troubles.append(f"seed {seed}: {found.verdict.value}: {found.reason}")
            continue
        inertia = found.inertia
        errors.append(inertia.value / TRUE_KG_M2 - 1.0)
        halves.append(0.5 * (inertia.high - inertia.low) / inertia.value)
        misses += not inertia.low <= TRUE_KG_M2 <= inertia.high
    low, high = bounds(misses, len(errors)) if errors else (0.0, 1.0)
    if len(errors) > 1:
        missed = f"{misses:>2} of {len(errors)} missed ({100 * low:4.1f} to {100 * high:4.1f} %)"
        scatter = f"error {100 * fmean(errors):+5.2f} %, sd {100 * stdev(errors):4.2f} %"
        width = f"half-width {100 * median(halves):4.2f} %"
        took = f"{time.monotonic() - begun_s:.0f} s"
        print(f"{row.name:<24} {rate_hz:>6.1f} Hz  {missed}  {scatter}  {width}  {took}", flush=True)
    for trouble in troubles:
        print(f"{row.name:<24} {trouble}", flush=True)
    return low <= 0.05 and not troubles


def main() -> int:
    """Prints the table; 0 if every row covers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seeds", type=int, default=20, help="of each row")
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--rows", default="", help="only those whose name holds this")
    parser.add_argument("--speed-only", action="store_true", help="a drive without torque mode")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    rows = [row for row in ROWS if asked.rows in row.name]
    good = [measure(row, seeds, speed_only=asked.speed_only) for row in rows]
    return 0 if all(good) and good else 1


if __name__ == "__main__":
    sys.exit(main())
