"""A thousand logs of twenty rigs, ten of them invalid: every way gives the same table, in spite of kills; the cost.

    python benchmarks/fleet_thousand.py [--logs 1000] [--roads pool one dask] [--kills 50] [--folder DIR]
    python benchmarks/fleet_thousand.py --quick [--interrupt 20]
    python benchmarks/fleet_thousand.py --cost [--copies 20]

With --quick logs are hashed and not identified: the machinery alone, within minutes; with --interrupt it is `tdhil
fleet` in a terminal, where Ctrl-C is pressed so often, and each time started again. The logs are real run.mcap files of
the studies' batch simulator. With --cost: CPU seconds a log of a real run's size (simulated once, 8.7
MB), cold and from the cache, beside a plain replay; memory; how soon the pool starts.
"""

import argparse
import json
import os
import random
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from tdhil.errors import TdhilError  # noqa: E402
from tdhil.fleet import FleetRequest, FleetRow, FleetSettings, read_table, run_fleet  # noqa: E402
from tdhil.process_pool import Pool, TaskLimits  # noqa: E402
from tests.fleet import poison  # noqa: E402
from tests.fleet.killer import Killer, cluster_processes, pool_processes  # noqa: E402
from tests.fleet.simulated_logs import rig_plants, write_rig  # noqa: E402
from tests.fleet.terminal import fleet_with_ctrl_c  # noqa: E402
from tests.process_pool.poison import work  # noqa: E402
from tests.recording.test_damage import bomb  # noqa: E402

LIMITS = TaskLimits(60.0, 1_500_000_000)
POISONED = {
    "kills": (2, poison.KILLS), "hangs": (2, poison.HANGS), "bomb": (1, bomb("zstd", 500_000_000, 500_000_000)),
    "corrupt": (2, b"\x89MCAP0\r\n" + random.Random(1).randbytes(100_000)), "empty": (1, b""),
    "foreign": (1, b"GIF89a"),
}


def generate(folder: Path, logs: int, rigs: int) -> None:
    began, cpu = time.monotonic(), time.process_time()
    folder.mkdir(parents=True)
    for number, plant in enumerate(rig_plants(rigs)):
        place = folder / plant.name
        place.mkdir()
        for _ in write_rig(place, plant, logs // rigs, 1 + number):
            pass
    rng = random.Random(7)
    every = sorted(folder.rglob("*.mcap"))
    victims = rng.sample(every, 10)
    for count, content in POISONED.values():
        for _ in range(count):
            victims.pop().write_bytes(content)
    gone = victims.pop()                       # unreadable, for root too: a link to what isn't there
    gone.unlink()
    gone.symlink_to("nowhere")
    wall_s, cpu_s = time.monotonic() - began, time.process_time() - cpu
    print(f"{len(every)} logs of {rigs} rigs made in {wall_s:.0f} s, {cpu_s:.0f} s CPU", flush=True)


def by_road(road: str, request: FleetRequest, kills: int, function: Any, workers_too: bool) -> tuple[FleetRow, ...]:
    began = time.monotonic()
    if road == "dask":
        import dask
        from distributed import LocalCluster

        dask.config.set({"distributed.scheduler.allowed-failures": 10})
        with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=40) as cluster:
            killer = Killer(kills, lambda: cluster_processes(cluster, workers_too))
            there = replace(request, scheduler=cluster.scheduler_address)
            while True:
                try:
                    summary = run_fleet(there, killer, function=function)
                    break
                except TdhilError as error:                 # all workers are down at once: as a user would do
                    print(f"dask : {error.what}: the same again", flush=True)
                    there = replace(there, again=False)
                    time.sleep(5.0)
    else:
        killer = Killer(kills if road == "pool" else 0, lambda: pool_processes(os.getpid()))
        summary = run_fleet(replace(request, jobs=2 if road == "pool" else 1), killer, function=function)
    rows = summary.rows
    names = Counter(row.log for row in rows)
    bad = Counter(row.error_kind or row.verdict for row in rows if row.verdict not in ("valid", "valid_wide"))
    print(f"{road:5}: {len(rows)} rows, {len(rows) - bad.total()} results, {dict(bad)}; {killer.kills} killed; "
          f"lost {summary.left}, twice {sum(count > 1 for count in names.values())}; "
          f"{summary.cpu_s / max(1, len(rows)):.3f} s CPU a log, {time.monotonic() - began:.0f} s in all", flush=True)
    return rows


def thousand(asked: argparse.Namespace, folder: Path) -> None:
    logs = folder / "logs"
    if not logs.exists():
        generate(logs, asked.logs, asked.rigs)
    function = poison.quick if asked.quick else poison.identify
    os.environ["TDHIL_CALLS"] = str(folder / "calls.txt")
    tables = {}
    for road in asked.roads:
        request = FleetRequest((str(logs),), folder / f"{road}.parquet", limits=LIMITS, cache=False, again=True)
        tables[road] = [repr(row) for row in by_road(road, request, asked.kills, function, asked.kill_workers)]
    first = next(iter(tables.values()))
    for road, rows in tables.items():
        differ = sum(a != b for a, b in zip(rows, first, strict=True))
        print(f"{road}: {differ} rows differ from {next(iter(tables))}'s")


def interrupted(asked: argparse.Namespace, folder: Path) -> None:
    """Ctrl-C in a terminal, again and again: what was done is done once, but for what was in hand."""
    logs, out, calls = folder / "logs", folder / "interrupted.csv", folder / "interrupted_calls.txt"
    if not logs.exists():
        generate(logs, asked.logs, asked.rigs)
    calls.write_text("")
    os.environ["TDHIL_CALLS"] = str(calls)
    arguments = [str(logs), "--out", str(out), "--jobs", "2", "--no-cache", "--time-limit", str(LIMITS.time_s)]
    rng, codes = random.Random(3), Counter[int]()

    def begun() -> int:
        return calls.read_text().count("\n")

    for _ in range(asked.interrupt):
        least = begun() + rng.randint(1, max(2, asked.logs // asked.interrupt))
        codes[fleet_with_ctrl_c("quick", arguments, lambda least=least: begun() >= least)] += 1
    codes[fleet_with_ctrl_c("quick", arguments, lambda: False)] += 1
    rows, twice = read_table(out), Counter(Counter(calls.read_text().split("\n")[:-1]).values())
    logged, good = {row.log for row in rows}, sum(not row.failed for row in rows)
    print(f"{asked.interrupt} times Ctrl-C: exit codes {dict(codes)}; {len(rows)} rows of {len(logged)} logs, {good} "
          f"results; number of starts: {dict(sorted(twice.items()))}")


def cost(asked: argparse.Namespace, folder: Path) -> None:
    import tdhil
    from tdhil.recording.log_format import CLASSES, CONFIGURATION
    from tdhil.recording.salvage import examine, write_copy

    log = folder / "run.mcap"
    with tdhil.simulate(seed=7) as drive:
        tdhil.run(drive, log=log)
    found = examine(log)
    logs = folder / "copies"
    logs.mkdir()
    for number in range(asked.copies):
        def noted(channel: int, payload: bytes, number: int = number) -> bytes:
            if channel != CONFIGURATION:
                return payload
            content = json.loads(CLASSES["Text"].FromString(payload).json)
            content["run"]["note"] = f"copy {number}"
            return CLASSES["Text"](json=json.dumps(content)).SerializeToString()

        write_copy(log, logs / f"{number}.mcap", found, noted)
        if number == 0:
            print(f"{log.stat().st_size / 1e6:.1f} MB a run, {len(found.run.recording.time_s)} samples")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "tdhil", "replay", str(log), "--json"], check=True,
                   stdout=subprocess.DEVNULL, cwd=ROOT)
    print(f"tdhil replay, a process of its own: {children_cpu_s(before):.2f} s CPU")
    request = FleetRequest((str(logs),), folder / "cost.csv", jobs=2)
    for what, settings in (("cold", FleetSettings()), ("from the cache", FleetSettings(confidence=0.9))):
        before, own, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.process_time(), time.monotonic()
        summary = run_fleet(replace(request, settings=settings))
        whole = children_cpu_s(before) + time.process_time() - own
        rest = sorted(cpu_s for _, cpu_s in summary.slowest)
        print(f"{what}: {whole / asked.copies:.3f} s CPU a log, all processes and their starts included "
              f"({summary.cpu_s / asked.copies:.3f} in the tasks; slowest {rest[-1]:.2f}), "
              f"{time.monotonic() - began:.1f} s in all; "
              f"{resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024:.0f} MB the largest process")
    began = time.monotonic()
    with Pool(work, 2, LIMITS) as pool:
        list(pool.run([1, 2]))
    print(f"start of the pool: {time.monotonic() - began:.2f} s until two processes have answered")


def children_cpu_s(before: Any) -> float:
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return float(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=1000)
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--roads", nargs="+", choices=("pool", "one", "dask"), default=["pool", "one", "dask"])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--kill-workers", action="store_true", help="kill Dask's own workers, too")
    parser.add_argument("--quick", action="store_true", help="the machinery alone: rows without identifying")
    parser.add_argument("--folder", type=Path, help="where logs and tables stay")
    parser.add_argument("--interrupt", type=int, default=0, metavar="N", help="number of Ctrl-C")
    parser.add_argument("--cost", action="store_true")
    parser.add_argument("--copies", type=int, default=20)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tdhil-thousand-") as folder:
        place = asked.folder or Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        (cost if asked.cost else interrupted if asked.interrupt else thousand)(asked, place)


if __name__ == "__main__":
    main()
