"""Time that a user waits for: a replay and a simulated run beside what each needs at least, and tuning in seconds.

    python benchmarks/waiting_time.py [--rounds 5] [--cycles 73000] [--require-replay 2.2] [--require-run 1.0]
                                      [--require-tune 10] [--require-help 5]
    python benchmarks/waiting_time.py --click [--rounds 5] [--busy 8]

replay  `tdhil replay run.mcap` beside `import numpy, scipy.linalg, scipy.special`, each a process of its own. The
        import has as many threads as numpy takes by itself.
run     `tdhil identify --simulate` beside a loop of python-can alone over as many cycles: RPDO and SYNC out, TPDO in,
        and a thread with python-can alone that answers (loop A of cycle_rate.py).
tune    `tdhil tune soft-torque` for a top drive and a string of 3000 m, in seconds. Its limit holds for a computer that
        does nothing else.
help    `tdhil --help` beside `import argparse`, each a process of its own. The limit is that of issue 26, 0.1 s, over
        the 0.02 s that the import takes on the computer of benchmarks/README.md.

click   a simulated run in Chromium: seconds from the click on Start until the page shows J, and until its first picture
        is drawn. First with nothing beside it, then beside ``--busy`` processes that never pause. Measured alone, with
        `--click` (extra `browser`); no limit holds.

User CPU time of the child processes (getrusage). The processes take turns, and the median of the rounds counts. Other
programs on this computer change the seconds. The ratios change less. The exit code is 1 if a limit is exceeded.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
IMPORTS = "import numpy, scipy.linalg, scipy.special"
RESULT = {
    "verdict": "valid", "gear_ratio": 10.0, "simulated": True, "cycle": {"period_s": 0.02}, "profile": None,
} | {name: {"value": value, "low": low, "high": high, "low_total": low, "high_total": high}
     for name, value, low, high in (
    ("inertia_kg_m2", 15.0, 14.4, 15.6), ("viscous_nm_s_rad", 0.08, 0.07, 0.09), ("coulomb_nm", 6.0, 5.9, 6.1),
    ("speed_lag_s", 0.4, 0.39, 0.41))}
"""Result of an identification, for `tune`: a top drive, at the motor shaft."""
CLICKED = "simulated-canopen"
"""The rig whose run is started by a click; it is in each service without rigs of its own."""
DRAWN = "() => [...document.querySelectorAll('figure img')].some((one) => one.complete && one.naturalWidth > 0)"
BUSY = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
BARE_LOOP = "from benchmarks.cycle_rate import bare; bare({cycles})"


def user_s(command: list[str], environment: Mapping[str, str]) -> float:
    """User CPU seconds of one process and its children."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT, env=environment)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


def wall_s(command: list[str], environment: Mapping[str, str]) -> float:
    """Seconds that one process takes."""
    began_s = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT, env=environment)
    return time.monotonic() - began_s


@contextmanager
def beside(busy: int) -> Iterator[None]:
    """Run this number of processes that never pause."""
    others = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in range(busy)]
    try:
        yield
    finally:
        for one in others:
            one.kill()
            one.wait()


def click_s(rounds: int) -> list[tuple[float, float]]:
    """Seconds from a click on Start until J is shown, and until the first picture is drawn; of each round."""
    import shutil

    from playwright.sync_api import sync_playwright

    sys.path.insert(0, str(ROOT))
    from tests.service.test_serve import served

    browser = os.environ.get("TDHIL_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    found = []
    with tempfile.TemporaryDirectory() as data, served(Path(data) / "data") as server, sync_playwright() as engine:
        chromium = engine.chromium.launch(executable_path=browser, args=["--no-sandbox", "--disable-dev-shm-usage"])
        page = chromium.new_page(base_url=server.url, viewport={"width": 1280, "height": 1180})
        page.set_default_timeout(600_000)
        for _ in range(rounds):
            page.goto(f"/start/{CLICKED}")
            page.get_by_role("button", name="Start", exact=True).click()
            began_s = time.monotonic()
            page.locator("p.figure.large").first.wait_for()
            shown_s = time.monotonic() - began_s
            page.wait_for_function(DRAWN)
            found.append((shown_s, time.monotonic() - began_s))
        chromium.close()
    return found


def clicks(rounds: int, busy: int) -> None:
    """Print the times after a click, on this computer as it is and beside busy processes."""
    for count in (0, busy):
        with beside(count):
            both = click_s(rounds)
        for name, each in zip(("J", "picture"), zip(*both, strict=True), strict=True):
            print(f"click to {name:8} beside {count} busy processes {statistics.median(each):7.2f} s "
                  f"({min(each):.2f} to {max(each):.2f}), load {os.getloadavg()[0]:.1f} at the end")


def main() -> int:
    """Print the medians and the ratios. Return 1 if a limit is exceeded."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--cycles", type=int, default=73_000, help="of the bare loop; those of the default run")
    parser.add_argument("--require-replay", type=float, default=2.2, metavar="R",
                        help="largest ratio of replay to import")
    parser.add_argument("--require-run", type=float, default=1.0, metavar="R", help="largest ratio of run to bare loop")
    parser.add_argument("--require-tune", type=float, default=10.0, metavar="S", help="longest tuning, s")
    parser.add_argument("--require-help", type=float, default=5.0, metavar="R",
                        help="largest ratio of the help to an import of argparse")
    parser.add_argument("--click", action="store_true", help="measure only the click, in Chromium")
    parser.add_argument("--busy", type=int, default=8, help="processes beside the second measurement of the click")
    wanted = parser.parse_args()
    if wanted.click:
        clicks(wanted.rounds, wanted.busy)
        return 0
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as folder:
        log = str(Path(folder) / "run.mcap")
        tdhil = [sys.executable, "-m", "tdhil"]
        result = Path(folder) / "result.json"
        result.write_text(json.dumps(RESULT), encoding="utf-8")
        tune = [*tdhil, "tune", "soft-torque", str(result), "--string", "examples/string.yaml", "--json"]
        commands = {
            "run": [*tdhil, "identify", "--drive", "canopen", "--simulate", "--seed", "7", "--json", "--log", log],
            "bare loop": [sys.executable, "-c", BARE_LOOP.format(cycles=wanted.cycles)],
            "replay": [*tdhil, "replay", log],
            "import": [sys.executable, "-c", IMPORTS],
            "help": [*tdhil, "--help"],
            "argparse": [sys.executable, "-c", "import argparse"],
        }
        took: dict[str, list[float]] = {name: [] for name in commands}
        for _ in range(wanted.rounds):
            Path(log).unlink(missing_ok=True)
            for name, command in commands.items():
                took[name].append(user_s(command, environment))
        tuned = [wall_s(tune, environment) for _ in range(wanted.rounds)]
    middle = {name: statistics.median(each) for name, each in took.items()}
    ratios = {name: middle[name] / middle[least]
              for name, least in (("replay", "import"), ("run", "bare loop"), ("help", "argparse"))}
    for name, each in took.items():
        print(f"{name:10} {middle[name]:7.2f} s of user CPU time ({min(each):.2f} to {max(each):.2f})")
    print(f"replay / import {ratios['replay']:.2f}   run / bare loop {ratios['run']:.2f}   "
          f"help / argparse {ratios['help']:.2f}")
    print(f"tune {statistics.median(tuned):.2f} s ({min(tuned):.2f} to {max(tuned):.2f})")
    found = ratios | {"tune": statistics.median(tuned)}
    limits = {"replay": wanted.require_replay, "run": wanted.require_run, "tune": wanted.require_tune,
              "help": wanted.require_help}
    exceeded = [f"{name} {found[name]:.2f} (limit {limit:g})" for name, limit in limits.items() if found[name] > limit]
    print(f"above the limit: {', '.join(exceeded) or 'none'}")
    return int(bool(exceeded))


if __name__ == "__main__":
    sys.exit(main())
