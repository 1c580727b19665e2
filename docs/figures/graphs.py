"""Draws good and bad graphs for the page on the graphs: ``python docs/figures/graphs.py [NAME ...]``.

Each picture is a simulated machine or record with one fault or none, drawn by the code of the report. Machines are
those of frequency_response.py and of the benches of the tests. Each row of `PICTURES` is one picture.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from chosen_names import chosen  # noqa: E402
from frequency_response import CASES, Machine, simulated  # noqa: E402

IMAGES = ROOT / "docs" / "images"
STRING_YAML = ROOT / "examples" / "string.yaml"
Draw = Callable[[Any], None]

MACHINES = CASES | {
    "limit": Machine(reported_limit=160.0),
    "bend": Machine(speeds=(1.4, 2.2, 3.4, 5.5), stribeck=60.0, lines=(0.1, 0.3, 0.5), amplitudes=(0.4, 0.1, 0.06)),
    "warming": Machine(speeds=(4.0, 7.0, 4.1), warming=(40.0, 60.0)),
    "loose": Machine(lost=(4.0, 125.0)),
    "slower_filter": Machine(lags_s=(0.40, 0.25)),
    "heavier": Machine(motor=116.0),
}
"""Name and machine: the faults of the page on the frequency response, and more."""


@dataclass(frozen=True)
class Pictured:
    """One picture. ``graph``: its row in `tdhil.report.GRAPHS`; ``draw`` returns what fills a figure of 7 by
    ``high_in`` inches.
    """

    graph: str
    draw: Callable[[], Draw]
    high_in: float
    names_left: bool = False


# ---------------------------------------------------------------------------------------------------------------------
# Runs of a machine

_MOST_SAMPLES = 500  # of a drawn run: the file stays small

@cache
def recording(name: str) -> Any:
    """Return the recording of a machine."""
    return simulated(MACHINES[name])


@cache
def document(name: str) -> Mapping[str, Any]:
    """Return the result document of a machine."""
    from tdhil.estimation import identify
    from tdhil.report import result_document

    return result_document(identify(recording(name)), recording(name), {}, f"{name}.mcap")


def _run(name: str, begin_s: float = 10.0, length_s: float = 25.0) -> Draw:
    """Return the graph of a part of a run, in which single periods can be seen."""
    from tdhil.report import draw_run

    whole = recording(name)
    part = np.flatnonzero((whole.time_s >= begin_s) & (whole.time_s <= begin_s + length_s))
    part = part[:: max(1, len(part) // _MOST_SAMPLES)]
    cut = {key: getattr(whole, key)[part] for key in ("time_s", "speed_rad_s", "torque_nm", "fresh", "limited")}
    return partial(draw_run, recording=replace(whole, excitation=None, **cut))


def _of_result(draw: str, name: str) -> Draw:
    from tdhil.report import plots

    return partial(getattr(plots, draw), document=document(name))


def _impedance(load_nm: float) -> Draw:
    """Return the graph of a drive's impedance. ``load_nm``: standard deviation of a random load on the shaft."""
    from dataclasses import asdict

    from tdhil.report.plots import draw_impedance
    from tests.estimation import impedance_bench as bench

    machine = bench.Machine(gain=82.2, integral=69.3, load_sd=load_nm)
    return partial(draw_impedance, found=asdict(bench.found(bench.record(machine, counted=6))))


PAGE = ROOT / "docs" / "reference" / "graphs.md"
LIVE_S = (60.0, 80.0, 118.0, 138.0, 148.0)
"""Times at which the run with a lost mass is analysed, s."""


def _until(whole: Any, end_s: float) -> Any:
    """Return the recording up to the last whole period before a time."""
    kept = whole.time_s <= end_s
    cut = {key: getattr(whole, key)[kept] for key in ("time_s", "speed_rad_s", "torque_nm", "fresh", "limited")}
    parts = []
    for one in whole.excitation.segments:
        periods = int((min(end_s, one.end_s) - one.start_s) // one.period_s)
        if periods > one.settle_periods + 1:
            parts.append(replace(one, end_s=one.start_s + periods * one.period_s))
    return replace(whole, excitation=replace(whole.excitation, segments=tuple(parts)), **cut)


def live_text() -> str:
    """Return J during a run in which a mass comes off the shaft, as a terminal of 80 columns shows it."""
    from rich.console import Console, Group

    from tdhil.estimation import identify
    from tdhil.report.live import inertia_rows
    from tdhil.runner.interim import live_inertia

    parts = [_until(recording("loose"), end_s) for end_s in LIVE_S]
    console = Console(file=io.StringIO(), width=80)
    console.print(Group(*inertia_rows([live_inertia(identify(part), part, 0.95) for part in parts], 80)))
    text = console.file.getvalue()  # type: ignore[attr-defined]
    return "\n".join(line.rstrip() for line in text.splitlines() if not line.startswith(("Good:", "Bad:")))


def _card_rows(*harmonics: tuple[int, float, float], play_rad: float = 0.0) -> str:
    """Return the rows of the card on torque over angle and backlash, and the warnings on backlash, in 80 columns.

    ``harmonics``: order, amplitude in N·m and phase in rad of each; ``play_rad``: of a coupling before 40 kg·m².
    """
    from rich.console import Console

    from tdhil.estimation import identify
    from tdhil.report import result_document
    from tdhil.report.card import backlash_rows, harmonic_rows
    from tdhil.report.console import names_and_texts
    from tests.estimation.angle_bench import OverAngle, run_over_angle
    from tests.estimation.shaft_bench import Rig
    from tests.estimation.stages_bench import Play

    play = Play(play_rad, 40.0, 20.0, viscous=2.0) if play_rad else None
    (found,) = run_over_angle(OverAngle(rig=Rig(harmonics=harmonics), play=play), [0])
    document = result_document(identify(found), found, {}, "run.mcap")
    console = Console(file=io.StringIO(), width=80)
    console.print(names_and_texts((*harmonic_rows(document), *backlash_rows(document))))
    for warning in document["warnings"]:
        if warning.startswith("backlash"):
            console.print(f"! {warning}", markup=False)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    return "\n".join(line.rstrip() for line in text.splitlines())


TEXTS: dict[str, Callable[[], str]] = {
    "live": live_text,
    "angle_good": partial(_card_rows, (6, 6.0, 0.7)),
    "angle_bad": partial(_card_rows, (1, 40.0, 0.7), (6, 6.0, 0.7)),
    "backlash": partial(_card_rows, play_rad=0.02),
}
"""Text on the page that the program makes, below a mark with its name."""


def with_text(page: str, name: str, text: str) -> str:
    """Return the page with the text in the block below its mark."""
    return re.sub(rf"(?<=<!-- {name} -->\n```text\n).*?(?=\n```\n)", lambda _: text, page, flags=re.DOTALL)


# ---------------------------------------------------------------------------------------------------------------------
# Speed loop


def _answer(*words: object) -> dict[str, Any]:
    """Return the document that a command prints."""
    from tdhil.cli.main import main as command

    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        command([*map(str, words), "--json"])
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


@cache
def _tuned(name: str, *more: str) -> Mapping[str, Any]:
    """Return the document of `tdhil tune speed` for a machine."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        path.write_text(json.dumps(document(name)), encoding="utf-8")
        return _answer("tune", "speed", path, "--inner-lags", "20ms", "10ms", "--dead-time", "3ms", *more)


def _loop(draw: str, name: str, *more: str) -> Draw:
    from tdhil.report import speed_loop

    found = _tuned(name, *more)
    return partial(getattr(speed_loop, draw), document={**found, "curves": _thinned(found["curves"]),
                                                        "steps": _thinned(found["steps"])})


def _thinned(part: Any) -> Any:
    """Return nested lists of a document with every third value: the file stays small."""
    if isinstance(part, Mapping):
        return {key: _thinned(value) for key, value in part.items()}
    return part[::3] if isinstance(part, list) else part


@cache
def _verified(share: float) -> Mapping[str, Any]:
    """Return the document of `tdhil tune verify` on the simulated drive, whose P is a share of the tuned one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tuned = _tuned("frf_good", "--bandwidth", "2")
        (folder / "tune.json").write_text(json.dumps(tuned), encoding="utf-8")
        gains = tuned["controllers"][-1]
        (folder / "plant.yaml").write_text(
            f"drive:\n  speed_gain_nm_s_rad: {share * gains['gain_nm_s_rad']}\n"
            f"  speed_integral_gain_nm_rad: {gains['integral_nm_rad']}\n", encoding="utf-8")
        return _answer("tune", "verify", folder / "tune.json", "--simulate", "--plant", folder / "plant.yaml",
                       "--seed", 5, "--log", folder / "v.mcap")


def _verification(share: float) -> Draw:
    from tdhil.report.verification import draw_verification

    found = _verified(share)
    return partial(draw_verification, document={**found, "response": _thinned(_thinned(found["response"]))})


# ---------------------------------------------------------------------------------------------------------------------
# Drill string


@cache
def _tuning() -> Any:
    """Return the tuning for 3,000 m of 5 inch pipe. The critical speeds are given, because the search takes minutes."""
    from tdhil.soft_torque import DrawnValues, Interval, Search, TuneCase, tune
    from tests.soft_torque.cases import DRIVE, STRING

    tuning = tune(TuneCase(STRING, DRIVE, Interval(1500.0, 1440.0, 1560.0)), None)
    speeds = {"stiff": (None, (180.0, 170.0)), "soft": (61.0, (60.0, 66.0))}
    kept = []
    for one in tuning.tuned:
        if one.kind in speeds:
            quiet, noisy = speeds[one.kind][0], DrawnValues(speeds[one.kind][1])
            kept.append(replace(one, quiet_cures=(quiet,) * 5, cure=noisy, start=noisy, linear_limit=noisy))
    return replace(tuning, searched=Search(highest_rpm=160.0), tuned=tuple(kept))


def _soft(draw: str) -> Draw:
    """Return a graph with a stiff and a soft controller."""
    from tdhil.report import TunedFor, map_document, showcase_of, tuning_document
    from tdhil.report.operator_map import draw_map
    from tdhil.report.tuning import draw_modes, draw_reflection, draw_showcase
    from tdhil.soft_torque import operator_map

    if draw == "stick_slip":
        return partial(draw_showcase, showcase=showcase_of(_tuning()))
    if draw == "map":
        return partial(draw_map, document=map_document(operator_map(_tuning())))
    found = tuning_document(_tuning(), TunedFor("result.json", True, None, 1.0, "drive", "as stated"))
    return partial(draw_reflection if draw == "reflection" else draw_modes, document=found)


def _schedule(depths: str) -> Draw:
    """Return the graph of the gains over depth, in m: first, last and step."""
    from tdhil.report.schedule import draw_schedule

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        path.write_text(json.dumps(document("frf_good")), encoding="utf-8")
        found = _answer("tune", "soft-torque", path, "--string", STRING_YAML, "--inner-lags", "20ms", "10ms", "3ms",
                        "--no-simulation", "--depths", depths)
    return partial(draw_schedule, document=found["schedule"])


@cache
def _drilled() -> Mapping[str, Any]:
    """Return time, and torque, speed of the top and of the bit under a stiff and a soft controller at 100 rpm."""
    from tests.soft_torque.cases import PAPER, SOFT_035
    from tests.soft_torque.chain_in_time import recorded, reference_case

    gains = [(one.gain_nm_s_rad, one.integral_nm_rad, one.compensated_kg_m2, one.derivative_filter_s)
             for one in (PAPER, SOFT_035)]
    time_s, torque, top, bit = recorded(**reference_case(
        laws=gains, rpm=np.array([[100.0], [100.0]]), periods=20.0, lumps=14, own_noise=True))
    return {name: (time_s, torque[:, k], top[:, k], bit[:, k]) for k, name in enumerate(("stiff", "soft"))}


def _severity(draw: str, controller: str) -> Draw:
    from tdhil.report import severity as pictures
    from tdhil.soft_torque import Interval, SurfaceRecord, severity
    from tests.soft_torque.cases import STRING
    from tests.soft_torque.chain_in_time import reported

    time_s, torque, top, _ = _drilled()[controller]
    lags_s = (0.1, 0.05)
    record = SurfaceRecord(*reported(time_s, torque, top, lags_s), *lags_s)
    return partial(getattr(pictures, draw), one=severity(record, STRING, Interval(1500.0, 1440.0, 1560.0)))


def _close(controller: str) -> Draw:
    """Return a minute of bit and top drive, as an evaluation shows it."""
    from tdhil.report.evaluation import draw_close
    from tdhil.soft_torque import COLUMNS, RPM, Phase

    time_s, _, top, bit = _drilled()[controller]
    rows = np.zeros((len(time_s), len(COLUMNS)))
    values = {"time_s": time_s, "phase": Phase.STEADY, "set_rad_s": 100.0 * RPM, "top_rad_s": top, "bit_rad_s": bit}
    for name, value in values.items():
        rows[:, COLUMNS.index(name)] = value
    return partial(draw_close, rows=rows, phase=Phase.STEADY, before_s=0.0)


# ---------------------------------------------------------------------------------------------------------------------
# Calibration

RUN_FACTS = {"date": "2026-01-01T08:00:00+00:00", "confidence": 0.95, "simulated": True}


def _bodies(stated_kg_m2: float) -> Draw:
    """Return the graph of three runs; ``stated_kg_m2``: inertia of the second body, which has 55 kg·m²."""
    from tdhil.report import draw_calibration
    from tdhil.session import document_of_calibration, find_calibration
    from tests.calibration.bodies import recording as with_body
    from tests.calibration.bodies import run

    with tempfile.TemporaryDirectory() as name:
        runs = [run(Path(name), f"{seed}.mcap", stated, with_body(body, seed), 0.1) for seed, body, stated in (
            (1, 0.0, 0.0), (2, 55.0, stated_kg_m2), (3, 110.0, 110.0))]
        return partial(draw_calibration, document=document_of_calibration(find_calibration(runs, "motor")))


def _pairs(hysteresis_nm: float) -> Draw:
    from tdhil.calibration import calibrate_pairs
    from tdhil.report import pairs_document
    from tdhil.report.factor_calibration import draw_pairs
    from tests.calibration.test_pairs import pairs

    found = pairs(np.random.default_rng(7), hysteresis=hysteresis_nm)
    return partial(draw_pairs, document=pairs_document(calibrate_pairs(found), found, "pairs.csv", {}, {}, **RUN_FACTS))


def _sensor(draw: str, fault: str = "") -> Draw:
    """Return a graph of a drive's torque and a sensor's. ``fault``: "drift" of the sensor, or a scale that "bends"."""
    from tdhil.calibration import calibrate_reference
    from tdhil.report import factor_calibration, reference_document
    from tests.calibration.reference_records import SensorBench, records

    bench = SensorBench(swing_nm=200.0, slow_noise_nm=2.5 if fault == "drift" else 0.0)
    drive, sensor = records(bench, np.random.default_rng(1))
    if fault == "bends":
        bent = drive.torque_nm - 0.0004 * drive.torque_nm * np.abs(drive.torque_nm)
        drive = replace(drive, torque_nm=bent)
    found = reference_document(calibrate_reference(drive, sensor), {"file": "sensor.csv", "at": "motor"}, (), {}, {},
                               **RUN_FACTS, warnings=())
    return partial(getattr(factor_calibration, draw), document=found)


# ---------------------------------------------------------------------------------------------------------------------
# Many runs


def _trend(kind: str) -> Draw:
    from tdhil.cli.trend import _draw_trend
    from tdhil.fleet import trend_document
    from tests.fleet.test_trend import rows

    found = trend_document(rows(kind)[0], "R7")
    inertia = [one for one in found["quantities"] if one["points"]][:1]
    return partial(_draw_trend, document={**found, "quantities": inertia})


def _compared(name: str) -> Draw:
    from tdhil.cli.trend import _draw_curves
    from tdhil.fleet import FleetSettings, compare_document
    from tdhil.fleet.rows import row_of
    from tdhil.fleet.trend import Compared

    runs = [Compared(row_of(f"{title}.mcap", document(one), settings=FleetSettings()), document(one), {})
            for title, one in (("before", "frf_good"), ("after", name))]
    return partial(_draw_curves, document=compare_document(runs))


# ---------------------------------------------------------------------------------------------------------------------

PICTURES = {
    "run_good": Pictured("run", partial(_run, "frf_good"), 2.2),
    "run_limit": Pictured("run", partial(_run, "limit"), 2.2),
    "run_zero": Pictured("run", partial(_run, "frf_zero"), 2.2),
    "run_quantised": Pictured("run", partial(_run, "frf_quantised"), 2.2),
    "run_warming": Pictured("run", partial(_run, "warming", 0.0, 80.0), 2.2),
    "estimates_bad": Pictured("estimates", partial(_of_result, "draw_opinions", "frf_stribeck"), 1.3, True),
    "lines_lag": Pictured("lines", partial(_of_result, "draw_lines", "frf_lag"), 2.6),
    "budget_noise": Pictured("budget", partial(_of_result, "draw_budget", "frf_quantised"), 1.6, True),
    "friction_bend": Pictured("friction", partial(_of_result, "draw_friction", "bend"), 1.8),
    "friction_warming": Pictured("friction", partial(_of_result, "draw_friction", "warming"), 1.8),
    "impedance_good": Pictured("impedance", partial(_impedance, 3.0), 2.6),
    "impedance_bad": Pictured("impedance", partial(_impedance, 60.0), 2.6),
    "open_loop_good": Pictured("open_loop", partial(_loop, "draw_loop", "frf_good"), 4.2),
    "open_loop_bad": Pictured("open_loop", partial(_loop, "draw_loop", "frf_resonance", "--present", "250", "150",
                                                   "--inner-lags", "300ms", "150ms", "--dead-time", "50ms"), 4.2),
    "step_good": Pictured("step", partial(_loop, "draw_step", "frf_good", "--bandwidth", "1"), 1.9),
    "step_bad": Pictured("step", partial(_loop, "draw_step", "frf_good", "--present", "300", "3000"), 1.9),
    "verified_step_good": Pictured("verified_step", partial(_verification, 1.0), 2.2),
    "verified_step_bad": Pictured("verified_step", partial(_verification, 0.7), 2.2),
    "reflection": Pictured("reflection", partial(_soft, "reflection"), 2.0),
    "modes": Pictured("modes", partial(_soft, "modes"), 1.8),
    "stick_slip": Pictured("stick_slip", partial(_soft, "stick_slip"), 2.8),
    "map": Pictured("map", partial(_soft, "map"), 2.4),
    "schedule_good": Pictured("schedule", partial(_schedule, "500:3000:500"), 2.0),
    "schedule_bad": Pictured("schedule", partial(_schedule, "500:6000:2750"), 2.0),
    "string_close_good": Pictured("string_close", partial(_close, "soft"), 1.8),
    "string_close_bad": Pictured("string_close", partial(_close, "stiff"), 1.8),
    "bit_speed_good": Pictured("bit_speed", partial(_severity, "draw_detail", "soft"), 1.8),
    "bit_speed_bad": Pictured("bit_speed", partial(_severity, "draw_detail", "stiff"), 1.8),
    "severity_good": Pictured("severity", partial(_severity, "draw_index", "soft"), 1.6),
    "severity_bad": Pictured("severity", partial(_severity, "draw_index", "stiff"), 1.6),
    "bodies_good": Pictured("bodies", partial(_bodies, 55.0), 3.0),
    "bodies_bad": Pictured("bodies", partial(_bodies, 62.0), 3.0),
    "pairs_good": Pictured("pairs", partial(_pairs, 0.0), 3.0),
    "pairs_bad": Pictured("pairs", partial(_pairs, 6.0), 3.0),
    "sensor_good": Pictured("sensor", partial(_sensor, "draw_reference"), 2.8),
    "sensor_bad": Pictured("sensor", partial(_sensor, "draw_reference", "drift"), 2.8),
    "linearity_good": Pictured("linearity", partial(_sensor, "draw_linearity"), 1.5),
    "linearity_bad": Pictured("linearity", partial(_sensor, "draw_linearity", "bends"), 1.5),
    "trend_good": Pictured("trend", partial(_trend, "none"), 1.8),
    "trend_bad": Pictured("trend", partial(_trend, "step 5 %"), 1.8),
    "compare_good": Pictured("compare", partial(_compared, "frf_good"), 2.0),
    "compare_filter": Pictured("compare", partial(_compared, "slower_filter"), 2.0),
    "compare_inertia": Pictured("compare", partial(_compared, "heavier"), 2.0),
}
"""Name of the picture: graph_NAME.svg."""

_METADATA = re.compile(r" *<metadata>.*?</metadata>\n", re.DOTALL)
_FONTS = re.compile(r"font-family: [^;\"]*sans-serif")
_PATHS = re.compile(r'(?<= d=")[^"]*')
_PLACES = re.compile(r'(?<=[ (][xy]=")-?[\d.]+|(?<=rotate\()[^)]*')
_LONG = re.compile(r"-?\d+\.\d{2,}")


def small(svg: str) -> str:
    """Return the same picture in fewer bytes: coordinates with one decimal, polylines without their letters."""
    def short(found: re.Match[str]) -> str:
        return _LONG.sub(lambda at: f"{float(at[0]):.1f}".removesuffix(".0"), found[0])

    def path(found: re.Match[str]) -> str:
        parts = short(found).split("\n")
        for k in range(len(parts) - 1, 0, -1):
            if parts[k].startswith("L ") and parts[k - 1][:2] in ("M ", "L "):
                parts[k] = parts[k][2:]        # a pair of numbers after M or L is the next place
        return " ".join(part.strip() for part in parts).strip()

    text = _FONTS.sub("font-family: sans-serif", _METADATA.sub("", svg))
    return _PLACES.sub(short, _PATHS.sub(path, text))


def picture(name: str) -> str:
    """Return a picture as SVG."""
    from tdhil.report import inline_svg

    one = PICTURES[name]
    return small(inline_svg(one.draw(), (7.0, one.high_in), names_left=one.names_left)) + "\n"


def main(names: Sequence[str]) -> int:
    """Draw the named pictures and write the named texts into the page, or all of both."""
    for name in [name for name in names or TEXTS if name in TEXTS]:
        PAGE.write_text(with_text(PAGE.read_text(encoding="utf-8"), name, TEXTS[name]()), encoding="utf-8")
        print(f"docs/reference/graphs.md: {name}", flush=True)
    for name in [name for name in names or PICTURES if name not in TEXTS]:
        path = IMAGES / f"graph_{name}.svg"
        path.write_text(picture(name), encoding="utf-8")
        print(f"docs/images/{path.name}: {path.stat().st_size} bytes", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(chosen(__doc__, (*TEXTS, *PICTURES), sys.argv[1:])))
