"""How often the momentum cross-check contradicts a sound run over Modbus, and finds a speed scale that slips.

    python benchmarks/cross_check_alarms.py [--seeds 200] [--first 1] [--profiles siemens/g120 ...] [--slip 0.9 1.1]

Every seed is a whole run of five stages on the default simulated rig in stepped time, over the line that the profile
describes; 2.5 s of processor time each. Of each profile: the disagreements with the upper bound of their rate (one
side, 95 %), the mean difference of the cross-check from the true J and from J of stage 5 with their standard errors,
and the median half-width. ``--slip``: the reported speed of each run is multiplied by the factor from stage 5 on, the
angle is left out, and it is counted how often no J stands. The end is 1 if a rate is above 1 % with 95 % confidence.

Seeds 1 to 200 of each line, and to 400 of the one with 5 among the first 200; slips of seeds 1 to 6, in brackets with
the estimator before the moment of reading was known. Where speed is reported in steps of 1 rpm (marked *) a mean error
beyond its standard error is left. Setpoints are the same in every seed, so that rounding, which is part of the
interval, need not average out; it was not separated from other causes.

| profile | cycles/s | disagree | mean error of J | from stage 5 | half-width | no J at 0.9 | at 1.1 |
|---|---|---|---|---|---|---|---|
| siemens/g120 | 15 | 1 of 200 | -0.28 ± 0.10 % | -0.28 ± 0.10 % | 3.2 % | 6 of 6 (0) | 5 of 6 (0) |
| abb/acs880-classic | 20 | 0 of 200 | -0.03 ± 0.12 % | -0.03 ± 0.11 % | 3.9 % | 5 of 6 (0) | 4 of 6 (0) |
| yaskawa/ga700 * | 10 | 2 of 200 | -0.53 ± 0.08 % | -0.51 ± 0.08 % | 2.9 % | 6 of 6 (3) | 5 of 6 (0) |
| schneider/atv340-930 * | 15 | 0 of 200 | -0.80 ± 0.11 % | -0.84 ± 0.12 % | 4.3 % | 4 of 6 (0) | 2 of 6 (0) |
| danfoss/fc302 *, speed mode | 10 | 0 of 200 | -0.88 ± 0.09 % | -0.38 ± 0.10 % | 6.1 % | 1 of 6 (0) | 0 of 6 (0) |
| delta/ms300 *, speed mode | 10 | 0 of 200 | +0.20 ± 0.10 % | +0.64 ± 0.10 % | 11.5 % | 0 of 6 (0) | 0 of 6 (0) |
| schneider/atv320 *, speed mode | 15 | 0 of 200 | -0.79 ± 0.11 % | -0.69 ± 0.11 % | 6.6 % | 0 of 6 (0) | 0 of 6 (0) |
| abb/acs880-enhanced | 50 | 0 of 200 | +0.16 ± 0.09 % | +0.16 ± 0.09 % | 3.1 % | 6 of 6 | 6 of 6 |
| siemens/g130-s120 | 50 | 5 of 400 | -0.05 ± 0.06 % | +0.02 ± 0.06 % | 2.2 % | 6 of 6 | 6 of 6 |
| lenze/i550, speed mode | 50 | 1 of 200 | -0.26 ± 0.09 % | -0.23 ± 0.08 % | 2.8 % | 3 of 6 | 0 of 6 |
| generic/modbus | 100 | 1 of 200 | -0.00 ± 0.08 % | +0.01 ± 0.08 % | 2.3 % | 6 of 6 | 6 of 6 |
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median, stdev

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

import numpy as np  # noqa: E402

from benchmarks.modbus_coverage import LIMITS, TRUE_KG_M2, Silent  # noqa: E402
from drivers.clock import SteppedClock  # noqa: E402
from drivers.modbus.drive import ModbusDrive  # noqa: E402
from drivers.modbus.link import EmbeddedLink  # noqa: E402
from profiles.library import load_modbus_profile, load_profile, profile_names  # noqa: E402
from sim_bus.modbus.embedded import EmbeddedModbusDrive  # noqa: E402
from sim_bus.params import RigParams  # noqa: E402
from tdhil.estimation import identify  # noqa: E402
from tdhil.estimation.result import Identification  # noqa: E402
from tdhil.recording.log_writer import RunWriter  # noqa: E402
from tdhil.recording.recording import Recording  # noqa: E402
from tdhil.recording.run_log import RunLog  # noqa: E402
from tdhil.runner.five_stages import Runner  # noqa: E402
from tdhil.runner.settings import ExcitationRequest, StopRequest  # noqa: E402
from tdhil.runner.task import Task  # noqa: E402

ALLOWED = 0.01


def run(name: str, seed: int, folder: Path) -> Recording:
    """One seed of a profile on its own line. Raises what ended the run."""
    profile, clock = load_modbus_profile(name), SteppedClock()
    with EmbeddedModbusDrive(RigParams(), profile, seed=seed) as peer:
        drive = ModbusDrive(
            EmbeddedLink(peer.serve, clock), profile, unit=peer.unit, given=dict(peer.untold),
            rated_torque_nm=peer.rated_torque_nm,
        )
        log = RunLog(RunWriter(folder / "run.mcap", epoch_ns=0, block=True), {})
        task = Task(replace(LIMITS, accept_no_watchdog=True), ExcitationRequest(), {"torque_scale_rel_sd": 0.02})
        outcome = Runner(drive, lambda _: task, log, StopRequest(), Silent(), lambda *_: None).run()
        log.close()
    if outcome.cause is not None:
        raise outcome.cause
    return log.recording(complete=True)


def slipped(recording: Recording, factor: float) -> Recording:
    """The same with another scale of speed from stage 5 on, and without the angle."""
    begun_s = next(stage.start_s for stage in recording.stages if stage.name == "acquire")
    speed = np.where(recording.time_s < begun_s, 1.0, factor) * recording.speed_rad_s
    return replace(recording, speed_rad_s=speed, position_rad=None)


def rate_bounds(count: int, of: int) -> tuple[float, float]:
    """Clopper and Pearson's lower and upper bound, 95 % each."""
    from scipy.stats import beta

    low = 0.0 if count == 0 else float(beta.ppf(0.05, count, of - count + 1))
    return low, 1.0 if count == of else float(beta.ppf(0.95, count + 1, of - count))


def measure(name: str, seeds: range, factors: Sequence[float]) -> bool:
    """Print one profile; False if it contradicts too many sound runs, or a run has no cross-check."""
    found: list[Identification] = []
    refused = dict.fromkeys(factors, 0)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            recording = run(name, seed, Path(folder))
        found.append(identify(recording))
        for factor in factors:
            refused[factor] += identify(slipped(recording, factor)).inertia is None
    told = [(one.second_opinions[0], one.inertia) for one in found if one.second_opinions and one.inertia is not None]
    if len(told) < 2:
        print(f"{name:<22} {len(found)} runs, {len(told)} with a cross-check", flush=True)
        return False
    errors = [opinion.inertia_kg_m2.value / TRUE_KG_M2 - 1.0 for opinion, _ in told]
    apart = [opinion.inertia_kg_m2.value / inertia.value - 1.0 for opinion, inertia in told]
    halves = [0.5 * (opinion.inertia_kg_m2.high - opinion.inertia_kg_m2.low) / TRUE_KG_M2 for opinion, _ in told]
    alarms = sum(opinion.agrees is False for opinion, _ in told)
    low, high = rate_bounds(alarms, len(told))
    means = ", ".join(
        f"{100 * fmean(values):+.2f} ± {100 * stdev(values) / math.sqrt(len(values)):.2f} % {of}"
        for values, of in ((errors, "of J"), (apart, "from stage 5"))
    )
    slips = "".join(f", x{factor:g}: no J in {count} of {len(found)}" for factor, count in refused.items())
    print(f"{name:<22} {len(found)} runs, {alarms} of {len(told)} disagree (at most {100 * high:.1f} %), {means}, "
          f"half-width {100 * median(halves):.1f} %{slips}", flush=True)
    return low <= ALLOWED and len(told) == len(found)


def main() -> int:
    """Print a line for each profile; 0 if none contradicts too many sound runs."""
    names = [name for name in sorted(profile_names()) if load_profile(name).bus == "modbus"]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200, help="of each profile (200)")
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--profiles", nargs="+", default=names, choices=names, metavar="NAME")
    parser.add_argument("--slip", type=float, nargs="*", default=[], metavar="FACTOR", help="scales of speed")
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    good = [measure(name, seeds, asked.slip) for name in asked.profiles]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
