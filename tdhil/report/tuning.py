"""Result of `tdhil tune`: as a JSON document, on a terminal, and as a page with figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

from rich.text import Text as Words

from profiles.quantities import printed_interval
from tdhil.report.blocks import AnswerBox, Column, Pairs, Picture, Report, ReportSection, Table, Text
from tdhil.report.console import (
    COMPENSATION_ORDER,
    ENTRY_ORDER,
    PlainConsole,
    figures_table,
    names_and_texts,
    print_settings,
)
from tdhil.report.document import marks
from tdhil.report.figure_words import meanings_section, print_meanings, words_of
from tdhil.report.intervals import part_with_interval
from tdhil.report.operator_map import map_figures, map_section, print_map
from tdhil.report.schedule import (
    finite,
    gain_words,
    noisy_speed,
    print_schedule,
    schedule_headings,
    schedule_section,
    settings_section,
    spread_document,
)
from tdhil.soft_torque import (
    BAND_HZ,
    HIGHEST_NOISY_RPM,
    MOST_GAIN_DB,
    NOISY_RESOLUTION,
    RPM,
    START_DRAWS,
    Begin,
    DrawnValues,
    DriveSetting,
    Interval,
    SimulationTrace,
    SpeedController,
    Tuned,
    Tuning,
    below,
    bit_jumps,
    has_light_bit,
    in_squares,
    longest_integral_time_s,
    reflection_at,
    simulate,
)
from tdhil.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import FigureBase

Part = Mapping[str, Any]

SIMULATION_ERROR_RPM, SIMULATION_ERROR_SHARE = 0.5, 0.015
"""Error of a simulated critical speed, rpm and share: half of the search's step, and the effects of the time step
and of the simulation's length (stiff loop of the reference case: 182 instead of 183)."""
LIGHT_BIT_ERROR_SHARE = 0.04
"""The share for a light bit (`has_light_bit`), such as one below collars that are stated as sections. The tick of the
search gives 75 rpm for 200 m of 8 inch collars, a chain of masses 78 rpm."""
JUMPING_BIT_ERROR_SHARE = 0.18
"""The share for a light bit that jumps from speed to speed (`bit_jumps`). For 200 m of 5 inch collars the search gives
107.5 rpm with ticks of 1.5 to 6 ms; a chain with 9 masses in the collars 122 rpm, with 18 masses 127 rpm."""
_COLOURS = {"present": "0.25", "stiff": "#c2410c", "soft": "#1f5fa8", "compensated": "#1a7f37", "broadband": "#7c3aed"}
_MEANT = {
    "cure": "lowest set speed that frees a stuck bit and keeps it turning, the top at full speed",
    "start": "lowest set speed at which the bit turns after a ramp from standstill",
}


@dataclass(frozen=True)
class TunedFor:
    """Source of the numbers."""

    source: str
    """Path of the result or log."""
    simulated: bool
    profile: str | None
    gear_ratio: float
    loop: str
    lags_from: str
    """Source of the lags in the loop."""
    present_from: str | None = None
    """Source of the present gains, or why the reported ones cannot be used. None: none are known."""
    settings: Mapping[str, tuple[DriveSetting, ...]] = field(default_factory=dict)
    """Settings in the drive's own parameters, by the controller's kind."""
    warnings: tuple[str, ...] = ()
    identified: Mapping[str, Any] = field(default_factory=dict)
    """Values of the result at the motor shaft that a virtual string on the same rig needs."""
    rehearsed_faults: tuple[str, ...] = ()
    """Faults that were scripted in the run."""
    lags_assumed: bool = False
    """True: the lags in the loop are neither stated nor measured."""


def tuning_document(tuning: Tuning, tuned_for: TunedFor) -> dict[str, Any]:
    """Return plain data for `json.dumps`: torques, inertias and gains at the named shaft; no infinite values."""
    import numpy as np

    case, string = tuning.case, tuning.case.string
    ratio = tuned_for.gear_ratio
    hertz = np.round(np.geomspace(0.02, 2.0, 160), 5)
    taken = [one for one in tuning.tuned if one.controller is not None]
    search = tuning.searched
    lag_s = case.drive.total_lag_s
    share = SIMULATION_ERROR_SHARE
    if search is not None and has_light_bit(string, search.longest_tick_s):
        share = LIGHT_BIT_ERROR_SHARE
    jumps = search is not None and bit_jumps(string, search.longest_tick_s)
    # For |r| > 1 the loop is stable only by the losses of the string, which are not measured.
    warnings, wide_hz = [*tuned_for.warnings], np.geomspace(0.02, 5.0, 300)
    if jumps:
        share = JUMPING_BIT_ERROR_SHARE
        warnings.append("The friction of the bit falls more steeply with speed than the lowest section damps, so the"
                        f" bit jumps from speed to speed. The critical speeds may be {100.0 * share:.0f} % too low."
                        " Take them as lower limits.")
    longest_s = longest_integral_time_s(tuning.string_modes_hz[0])
    for one in tuning.tuned:
        if one.controller is not None and search is not None and one.controller.integral_time_s > longest_s:
            warnings.append(f"{one.kind}: the integral time P/I is longer than {longest_s:.0f} s, eight periods of the "
                            "string. Stick-slip may then be too slow for the simulation. Take the critical speeds as "
                            "lower limits.")
        if one.controller is not None:
            over = reflection_at(case.drive, one.controller, string, wide_hz)
            if over.max() > 1.001:
                warnings.append(
                    f"{one.kind} reflects up to {over.max():.3f} of a wave at {wide_hz[int(over.argmax())]:.2g} Hz. "
                    "There, only the drag of mud and bit, as stated in string.yaml, keeps it stable.")
    lags_moved = [[end.drive.total_lag_s for end in pair] for pair in case.moves(present=False)]
    return {
        "tuned_for": {
            "source": tuned_for.source, "simulated": tuned_for.simulated, "profile": tuned_for.profile,
            "loop": tuned_for.loop, "gear_ratio": ratio, "present_from": tuned_for.present_from,
            "rehearsed_faults": list(tuned_for.rehearsed_faults),
        },
        "identified": dict(tuned_for.identified),
        "main_shaft": {
            "inertia_kg_m2": asdict(case.inertia_kg_m2),
            "viscous_nm_s_rad": case.drive.viscous_nm_s_rad,
            "coulomb_nm": case.drive.coulomb_nm,
            "inner_lags_s": list(case.drive.inner_lags_s),
            "inner_lags_from": tuned_for.lags_from,
            "inner_lag_s": asdict(in_squares(Interval(lag_s, lag_s, lag_s), lags_moved)),
        },
        "string": {
            "name": string.name,
            "impedance_nm_s_rad": string.impedance_nm_s_rad,
            "stiffness_nm_rad": string.stiffness_nm_rad,
            "echo_s": string.echo_s,
            "modes_hz": list(tuning.string_modes_hz),
            "bottom_inertia_kg_m2": string.bottom_inertia_kg_m2,
            "bit": None if string.bit is None else {
                **finite(asdict(string.bit)), "viscous_nm_s_rad": string.bottom_viscous_nm_s_rad,
                "words": f"{string.bit.describe()}, viscous {string.bottom_viscous_nm_s_rad:g} N·m·s/rad",
            },
        },
        "controllers": [_controller(one, ratio, tuned_for.settings.get(one.kind, ()), share) for one in tuning.tuned],
        "reflection": {
            "hertz": hertz.tolist(),
            **{one.kind: reflection_at(case.drive, one.controller, string, hertz).tolist()
               for one in taken if one.controller is not None},
        },
        "critical_speeds": None if search is None else {
            "meant": dict(_MEANT), "bit": "as stated in string.bit; valid for this bit only",
            "resolution_rpm": search.resolution_rpm, "highest_rpm": search.highest_rpm,
            "start_ramp_rpm_s": search.start_ramp_rpm_s,
            "under_noise": {
                "noise_nm": string.bit.noise_nm if string.bit else 0.0, "draws": len(tuning.truths),
                "start_draws": min(START_DRAWS, len(tuning.truths)),
                "resolution_share": NOISY_RESOLUTION, "highest_rpm": HIGHEST_NOISY_RPM,
            },
        },
        "required_margins": asdict(case.required),
        "advice": _advice(tuning, tuned_for),
        "warnings": warnings,
        "tdhil": __version__,
    }


def _controller(one: Tuned, ratio: float, settings: Sequence[DriveSetting], share: float) -> dict[str, Any]:
    law = one.controller
    head = {"kind": one.kind, "refused": one.refusal or None}
    if law is None:
        return {**head, "softest_a": _number(one.softest), "largest_share": one.largest_share}
    assert one.reflection and one.band_reflection and one.damping and one.margins
    return {
        **head,
        "a": one.softness, "softest_a": _number(one.softest),
        "compensated_share": one.compensated_share, "largest_share": one.largest_share,
        "at_main_shaft": gains_document(law), "at_motor": gains_document(law.at_shaft(ratio)),
        "integral_nm_rad_by_inertia": None if one.integral_nm_rad is None else asdict(one.integral_nm_rad),
        "drive_parameters": [asdict(setting) for setting in settings],
        "reflection_at_lowest_mode": asdict(one.reflection),
        "mean_reflection": {**asdict(one.band_reflection), "from_hz": BAND_HZ[0], "to_hz": BAND_HZ[1]},
        "least_damping": asdict(one.damping),
        "modes": [{"hertz": mode.frequency_hz, "damping": mode.damping} for mode in one.modes],
        "phase_margin_deg": one.margins.phase_deg, "crossover_rad_s": one.margins.crossover_rad_s,
        "least_distance_from_minus_1": one.margins.modulus,
        "lag_reserve_s": one.lag_reserve_s,
        "integral_time_s": _number(law.integral_time_s),
        "dead_time_reserve_s": one.dead_time_reserve_s,
        "frequency_factor": one.frequency_factor,
        "margins": None if one.worst is None or one.with_string is None else {
            "as_believed": finite(asdict(one.with_string)), "worst": finite(asdict(one.worst)),
            "failed": list(one.failed),
        },
        "critical_under_noise_rpm": None if one.cure is None or one.start is None else {
            "cure": spread_document(one.cure, NOISY_RESOLUTION), "start": spread_document(one.start, NOISY_RESOLUTION),
        },
        "linear_limit_rpm": None if one.linear_limit is None else spread_document(one.linear_limit, 0.0),
        "critical_rpm": {"cure": _quiet_part(one, share)} if one.quiet_cures else None,
        "inertia_wrong_by": [asdict(wrong) for wrong in one.wrong],
    }


def _quiet_part(one: Tuned, share: float) -> dict[str, float | None]:
    """Return value and ends over all intervals; None: not found below the highest speed tried.

    The ends include the search's resolution and the error of the simulation's grid.
    """
    value, ends = one.quiet_cure_rpm, one.quiet_cures
    pairs = one.quiet_cures_moved
    known = [end for end in ends if end is not None]
    if value is None or len(known) < len(ends) or any(end is None for pair in pairs for end in pair):
        known += [end for pair in pairs for end in pair if end is not None]
        return {"value": value, "low": min(known) if known else None, "high": None}
    moved = [[end for end in pair if end is not None] for pair in pairs]
    error = SIMULATION_ERROR_RPM + share * value
    found = in_squares(Interval(value, min(known), max(known)), [*moved, (value - error, value + error)])
    return {"value": value, "low": found.low, "high": found.high}


def _advice(tuning: Tuning, tuned_for: TunedFor) -> dict[str, Any]:
    """Return the advice, as one sentence and as data."""
    advice = tuning.advice
    base = tuning.by_kind(advice.compared_with)
    best = None if advice.kind is None else tuning.by_kind(advice.kind)
    return {
        "kind": advice.kind, "compared_with": advice.compared_with, "keep": advice.keep,
        "better_share": advice.better_share, "less_bad": advice.less_bad,
        "sentence": _sentence(tuning, base, best, " (for assumed lags)" if tuned_for.lags_assumed else ""),
        "thin": [] if base is None else list(base.failed),
    }


def _sentence(tuning: Tuning, base: Tuned | None, best: Tuned | None, lags: str) -> str:
    """Return the advice. ``lags``: a remark on assumed lags, or ''."""
    assert base is not None
    what = "the present gains" if base.kind == "present" else "a stiff speed loop"
    offered = any(one.controller is not None and not one.failed for one in tuning.tuned if one is not base)
    none = f"no other controller that tdhil tried keeps the margins{lags}"
    less_bad = None if tuning.advice.less_bad is None else tuning.by_kind(tuning.advice.less_bad)
    if less_bad is not None:
        return (f"The {less_bad.kind} gains are less bad than {what}, but they do not keep the margins{lags} either: "
                f"{', '.join(less_bad.failed)}. Compared with {what}: {_changes(tuning, base, less_bad)}. Shorten the "
                "lags inside the loop.")
    if best is None and not offered and base.worst is not None and not base.worst.stable:
        return (f"Do not keep {what}: they are unstable on a sampled machine. {none[0].upper()}{none[1:]}. Shorten the "
                "lags inside the loop, or lower the required --margins.")
    if best is None and not tuning.advice.keep:
        why, needed = ("no bit is stated", "State bottom.coulomb_nm in string.yaml (--string) to compare them.")
        if tuning.case.string.bit is not None:
            why, needed = "--no-simulation omits them", "Leave --no-simulation out to compare them."
        head = f"No gains are recommended: the critical speeds were not compared, because {why}. {needed}"
        soft = tuning.by_kind("soft")
        if soft is None or soft.controller is None:
            return head
        return f"{head} Soft gains, compared with {what}{lags}: {_changes(tuning, base, soft)}."
    if best is None:
        head = ("Keep what you have: " if base.kind == "present" else "Keep a stiff speed loop: ")
        if not offered:
            return f"{head}{none}." + _thin(what, base)
        speed = "" if base.cure is None else f" of {_rpm_words(base.cure)}"
        return (f"{head}no other controller lowers the critical speed{speed}{lags} by more than the search resolves."
                + _thin(what, base))
    return f"Type in the {best.kind} gains{lags}. Compared with {what}: {_changes(tuning, base, best)}."


def _thin(what: str, base: Tuned) -> str:
    """Return a sentence on the margins that the kept gains fail; '' without one."""
    return f" But {what} do not keep the margins: {', '.join(base.failed)}." if base.failed else ""


def _changes(tuning: Tuning, base: Tuned, best: Tuned) -> str:
    changes = []
    if base.cure is not None and best.cure is not None:
        low, high = best.cure.interval(NOISY_RESOLUTION * (best.cure.median or 0.0))
        end = "?" if high is None else f"{high:.0f}"
        changes.append(f"critical speed {_rpm_words(base.cure, unit=False)} → {_rpm_words(best.cure)} "
                       f"({low:.0f}–{end})")
    elif base.damping is not None and best.damping is not None:
        changes.append(f"least damping {base.damping.value:.2f} → {best.damping.value:.2f}")
    if base.worst is not None and best.worst is not None:
        limit = tuning.case.required.phase_deg
        before, after = (_degrees(one.worst.phase_deg, limit) for one in (base, best) if one.worst is not None)
        changes.append(f"phase margin {before} → {after}")
    return ", ".join(changes)


def _rpm_words(spread: DrawnValues, *, unit: bool = True) -> str:
    if spread.median is None:
        found = f"above {HIGHEST_NOISY_RPM:.0f}"
    elif spread.median <= spread.lowest_tried:
        found = f"below {spread.lowest_tried:.0f}"
    else:
        found = f"{spread.median:.0f}"
    return f"{found} rpm" if unit else found


def _degrees(value: float, limit: float) -> str:
    return f"{below(value, limit, 0)}°" if math.isfinite(value) else "none needed"


def gains_document(law: SpeedController) -> dict[str, float]:
    return {
        "gain_nm_s_rad": law.gain_nm_s_rad, "integral_nm_rad": law.integral_nm_rad,
        "compensated_kg_m2": law.compensated_kg_m2, "derivative_filter_s": law.derivative_filter_s,
    }


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


# ---------------------------------------------------------------------------------------------------------------------
# Output on a terminal.


def print_tuning(document: Part, console: PlainConsole) -> None:
    """Print gains, their effects and their conditions, in 80 columns."""
    simulated = f" · {found}" if (found := marks(document["tuned_for"])) else ""
    advice = document["advice"]
    console.print(Words(advice["sentence"], style="bold yellow" if advice["kind"] is None else "bold green"))
    for one in document["controllers"]:
        if not one["refused"] and one["margins"] and one["margins"]["failed"]:
            thin = ", ".join(one["margins"]["failed"])
            console.print(Words(f"{one['kind']}: thin margins, {thin}", style="bold red"))
    console.print()
    console.print(Words(f"speed controller for {_string_words(document)}{simulated}", style="bold"))
    console.print(names_and_texts(_rests_on(document)))
    console.print()
    console.print(figures_table(("", *(one["kind"] for one in document["controllers"] if not one["refused"])),
                                ((name, *cells) for name, cells in _rows(document))))
    console.print()
    if document.get("schedule"):
        print_schedule(document["schedule"], console)
    if document.get("map"):
        print_map(document["map"], console)
    print_meanings(_figures(document), console)
    console.print()
    for one in document["controllers"]:
        if one["refused"]:
            console.print(Words(f"{one['kind']} refused: {one['refused']}", style="yellow"))
    print_settings(list(_setting_rows(document)), console, _entry_order(document))
    console.print()
    for warning in document["warnings"]:
        console.print(Words(warning, style="yellow"))


def _string_words(document: Part) -> str:
    string = document["string"]
    return string["name"] or f"a string of ζ = {string['impedance_nm_s_rad']:.4g} N·m·s/rad"


def _rests_on(document: Part) -> Iterator[tuple[str, str]]:
    main, string, tuned_for = document["main_shaft"], document["string"], document["tuned_for"]
    yield "J, main shaft", part_with_interval(main["inertia_kg_m2"], "kg·m²")
    lags = " + ".join(f"{1e3 * lag:.3g}" for lag in main["inner_lags_s"])
    whole = main["inner_lag_s"]
    yield "lags in the loop", f"{lags} ms, {main['inner_lags_from']}" + (
        f"; together {1e3 * whole['value']:.3g} ({printed_interval(1e3 * whole['low'], 1e3 * whole['high'], 3)}) ms"
        if whole["high"] > whole["low"] else "")
    yield "ζ", f"{string['impedance_nm_s_rad']:.4g} N·m·s/rad"
    yield "echo", f"after {string['echo_s']:.3f} s"
    yield "modes", ", ".join(f"{hertz:.3g}" for hertz in string["modes_hz"]) + " Hz"
    bit = string["bit"]
    yield "bit", bit["words"] if bit else "not stated; tdhil reports no critical speeds"
    if bit:
        yield "bit noise", f"{bit['noise_nm']:.0f} N·m rms, correlation time {bit['noise_correlation_s']:.2g} s"
    if tuned_for.get("present_from"):
        yield "present gains", tuned_for["present_from"]
    if tuned_for["loop"] == "bus":
        yield "loop", "closed over the bus, in torque mode: the lag of the reported speed is included"


def _figures(document: Part) -> list[str]:
    """Return the names of all rows and columns of the card and the page."""
    names = [name for name, _ in (*_rests_on(document), *_rows(document))]
    names += ["in brackets", "*", "draws", *(one["kind"] for one in document["controllers"])]
    if any(name.endswith("wrong") for name in names):
        names.append("errors of J")
    if document.get("schedule"):
        names += schedule_headings(document["schedule"])
    if document.get("map"):
        names += map_figures(document["map"])
    return names


def _interval(part: Part, digits: int = 2) -> str:
    return f"{part['value']:.{digits}f} ({part['low']:.{digits}f}–{part['high']:.{digits}f})"


def _rows(document: Part) -> Iterator[tuple[str, list[str]]]:
    """Yield the name of each figure and its values, one for each controller."""
    taken = [one for one in document["controllers"] if not one["refused"]]
    ratio = document["tuned_for"]["gear_ratio"]
    shafts = [("at_main_shaft", ", main"), ("at_motor", ", motor")] if ratio != 1.0 else [("at_motor", "")]
    for key, shaft in shafts:
        yield f"P{shaft}", [gain_words(one[key]["gain_nm_s_rad"]) for one in taken]
        yield f"I{shaft}", [gain_words(one[key]["integral_nm_rad"]) for one in taken]
        if any(one[key]["compensated_kg_m2"] for one in taken):
            yield f"J_c{shaft}", [gain_words(one[key]["compensated_kg_m2"]) for one in taken]
    noise = document["critical_speeds"] is not None
    if noise:
        yield "critical, rpm", [noisy_speed(one["critical_under_noise_rpm"]["cure"]) for one in taken]
        yield "  by ramp, rpm", [noisy_speed(one["critical_under_noise_rpm"]["start"]) for one in taken]
        yield "  linear, rpm", [_interval(one["linear_limit_rpm"], 0) for one in taken]
    required = document["required_margins"]
    yield "phase margin", [_margin(one, required, "phase_deg", 0, "°") for one in taken]
    yield "gain margin, dB", [_margin(one, required, "gain_db", 1) for one in taken]
    yield "dead time, ms", [_margin(one, required, "dead_time_s", 0, times=1e3) for one in taken]
    yield "P/I, s", ["–" if one["integral_time_s"] is None else f"{one['integral_time_s']:.3g}" for one in taken]
    yield "a, φ", ["–" if one["a"] is None else f"{one['a']:.2g}, {one['frequency_factor']:.2g}" for one in taken]
    yield "J compensated", [f"{100 * one['compensated_share']:.0f} %" for one in taken]
    yield "|r|, mean", [f"{one['reflection_at_lowest_mode']['value']:.2f}, {one['mean_reflection']['value']:.2f}"
                        for one in taken]
    yield "damping *", [f"{one['least_damping']['low']:.2f}–{one['least_damping']['high']:.2f}" for one in taken]
    if noise:
        yield "no noise *, rpm", [_speed(one["critical_rpm"]["cure"], document) for one in taken]
    wrongs: list[Part] = next((one["inertia_wrong_by"] for one in taken if one["inertia_wrong_by"]), [])
    for k, error in enumerate(wrong["error"] for wrong in wrongs):
        yield (f"J {100 * error:+.3g} % wrong",
               [_wrong(one["inertia_wrong_by"][k]) if one["inertia_wrong_by"] else "–" for one in taken])


def _margin(one: Part, required: Part, key: str, digits: int, unit: str = "", times: float = 1.0) -> str:
    """Return the least margin over the sampled true values; "!" before an insufficient one."""
    if one["margins"] is None:
        return "–"
    worst = one["margins"]["worst"]
    if not worst["stable"]:
        return "!unstable"
    value = math.inf if worst[key] is None else worst[key]
    if key == "gain_db" and value > MOST_GAIN_DB:
        return f"> {MOST_GAIN_DB:g}"        # larger ones are not searched
    if value == math.inf:
        return "no limit"
    return ("!" if value < required[key] else "") + below(times * value, times * required[key], digits) + unit


def _speed(part: Part, document: Part) -> str:
    if part["value"] is None:
        return f"> {document['critical_speeds']['highest_rpm']:.0f}"
    high = "?" if part["high"] is None else f"{part['high']:.0f}"
    return f"{part['value']:.0f} ({part['low']:.0f}–{high})"


def _wrong(part: Part) -> str:
    if not part["stable"]:
        return "unstable"
    critical = "" if part["cure_rpm"] is None else f", {part['cure_rpm']:.0f} rpm"
    return f"{part['damping']:.2f}{critical}"


def _entry_order(document: Part) -> str:
    compensated = any(not one["refused"] and one["compensated_share"] for one in document["controllers"])
    return f"{ENTRY_ORDER} {COMPENSATION_ORDER}" if compensated else ENTRY_ORDER


def _setting_rows(document: Part) -> Iterator[tuple[str, str, str]]:
    """Yield (parameter, value to enter for each controller, confidence), one row for each parameter."""
    taken = [one for one in document["controllers"] if one.get("drive_parameters")]
    for k in range(len(taken[0]["drive_parameters"]) if taken else 0):
        own = [one["drive_parameters"][k] for one in taken]
        first = own[0]
        values = first["why"] if first["value"] is None else ", ".join(
            f"{one['kind']} {gain_words(setting['value'])}" for one, setting in zip(taken, own, strict=True)
        ) + f" {first['unit']}"
        yield first["title"], values, first["confidence"]


# ---------------------------------------------------------------------------------------------------------------------
# Page of the tuning.


@dataclass(frozen=True)
class Showcase:
    """Stick-slip under the stiff loop and none under a tuned one: bit and top at one set speed."""

    set_rpm: float
    kinds: tuple[str, ...]
    trace: SimulationTrace


def showcase_of(tuning: Tuning, seconds: float = 60.0) -> Showcase | None:
    """Return the motion at a set speed at which the bit sticks only under the stiff loop; None without such a speed."""
    import numpy as np

    found = {one.kind: one for one in tuning.tuned if one.controller is not None and one.quiet_cures}
    stiff = found.get("stiff")
    tuned = [one for kind, one in found.items()
             if kind not in ("stiff", "present") and one.quiet_cure_rpm]
    if stiff is None or not tuned or tuning.searched is None:
        return None
    advised = [one for one in tuned if one.kind == tuning.advice.kind]
    best = min(advised or tuned, key=lambda one: one.quiet_cure_rpm or math.inf)
    assert best.quiet_cure_rpm is not None
    above = stiff.quiet_cure_rpm or tuning.searched.highest_rpm
    if above < 1.1 * best.quiet_cure_rpm:
        return None
    rpm = float(round(math.sqrt(above * best.quiet_cure_rpm)))
    loops = [(tuning.case.drive, one.controller) for one in (stiff, best) if one.controller is not None]
    target = np.full((len(loops), 1), rpm * RPM)
    trace = simulate(tuning.case.string, loops, Begin("stuck", target), target, 1.0, seconds, 0.05)
    return Showcase(rpm, (stiff.kind, best.kind), trace)


def tuning_report(document: Part, showcase: Showcase | None) -> Report:
    """Return the blocks of the page."""
    taken = [one for one in document["controllers"] if not one["refused"]]
    best = next((one for one in taken if one["kind"] == document["advice"]["kind"]), None)
    sections = [
        ReportSection("Controllers", (
            Table((Column("", 0.24), *(Column(one["kind"], 0.76 / max(1, len(taken)), number=True) for one in taken)),
                  tuple((name, *(cell.replace("!", "⚠ ") for cell in cells)) for name, cells in _rows(document))),
            *(Text(f"{one['kind']}: thin margins, {', '.join(one['margins']['failed'])}.") for one in taken
              if one["margins"] and one["margins"]["failed"]),
            *(Text(f"{one['kind']} refused: {one['refused']}") for one in document["controllers"] if one["refused"]),
        )),
        ReportSection("Reflection of the top drive", (
            Picture("reflection", partial(draw_reflection, document=document), 2.6,
                    "|r(f)| at the top of the string: 1 reflects a wave completely, 0 absorbs it. Dotted: the string's "
                    "modes with the top held."),
        )),
        ReportSection("Modes and their damping", (
            Picture("modes", partial(draw_modes, document=document), 2.3,
                    "Damping ratio of each mode of string and top drive together. The table has the least one below "
                    "the second mode of the string."),
        )),
    ]
    if showcase is not None:
        sections.append(ReportSection("Stick-slip, with and without", (
            Picture("stick_slip", partial(draw_showcase, showcase=showcase), 1.7 * len(showcase.kinds) + 0.5,
                    f"Simulated, without bit noise: the bit starts stuck, at a set speed of {showcase.set_rpm:.0f} rpm."
                    " The bit is in colour, the top drive in grey."),
        )))
    if document.get("map"):
        sections.append(map_section(document["map"], document["string"]["bit"]["words"]))
    sections.append(settings_section(list(_setting_rows(document)), _entry_order(document)))
    if document.get("schedule"):
        sections.append(schedule_section(document["schedule"]))
    of_page = [("from", document["tuned_for"]["source"]), ("profile", document["tuned_for"]["profile"] or "none")]
    sections += [ReportSection("Basis of the result", (Pairs((*_rests_on(document), *of_page)),)),
                 meanings_section([*_figures(document), *(name for name, _ in of_page)])]
    simulated = document["tuned_for"]["simulated"]
    return Report(
        title="Speed controller and drill string",
        subtitle=_string_words(document),
        simulated=f"{marks(document['tuned_for'])}: J is that of a simulated rig" if simulated else "",
        answer=_answer(best, document),
        warnings=tuple(document["warnings"]),
        sections=tuple(sections),
        footer=f"tdhil {document['tdhil']}",
    )


def _answer(best: Part | None, document: Part) -> AnswerBox:
    sentence = document["advice"]["sentence"]
    if best is None:
        thin = document["advice"]["thin"]
        lines = (f"Thin: {', '.join(thin)}.",) if thin else ()
        headline, verdict = "Nothing to change", "keep what you have"
        if thin:
            headline, verdict = "No better gains were found", "the gains in place do not keep the margins"
        elif not document["advice"]["keep"]:
            headline, verdict = "No gains are recommended", "critical speeds not compared"
        if document["advice"].get("less_bad"):
            headline = "No gains keep the margins"
        return AnswerBox("red" if thin else "yellow", headline, lines, verdict, sentence, "")
    gains = best["at_motor"]
    remarks = [f"At the motor shaft. {best['kind'].capitalize()}: {words_of(best['kind'])}"]
    if gains["compensated_kg_m2"]:
        remarks.append(f"inertia compensation J_c = {gains['compensated_kg_m2']:.4g} kg·m², with a filter of "
                     f"{1e3 * gains['derivative_filter_s']:g} ms on the measured acceleration")
    headline = f"P = {gain_words(gains['gain_nm_s_rad'])} N·m·s/rad, I = {gain_words(gains['integral_nm_rad'])} N·m/rad"
    required = document["required_margins"]
    verdict = (f"keeps a phase margin of {required['phase_deg']:.0f}°, a gain margin of {required['gain_db']:g} dB and "
               f"a dead-time reserve of {1e3 * required['dead_time_s']:.0f} ms on every sampled machine and string")
    return AnswerBox("green", headline, tuple(remarks), verdict, sentence, "")


def draw_reflection(figure: FigureBase, document: Part) -> None:
    """Draw |r(f)| of every controller."""
    axes = figure.subplots()
    curves = document["reflection"]
    for hertz in document["string"]["modes_hz"]:
        axes.axvline(hertz, color="0.6", lw=0.8, ls=":")
    for kind, colour in _COLOURS.items():
        if kind in curves:
            axes.semilogx(curves["hertz"], curves[kind], color=colour, lw=1.5, label=kind)
    axes.set(xlabel="frequency, Hz", ylabel="|r|", ylim=(0.0, 1.05), xlim=(curves["hertz"][0], curves["hertz"][-1]))
    ticks = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")


def draw_modes(figure: FigureBase, document: Part) -> None:
    """Draw damping over frequency."""
    axes = figure.subplots()
    for one in document["controllers"]:
        if not one["refused"]:
            axes.plot([mode["hertz"] for mode in one["modes"]], [mode["damping"] for mode in one["modes"]], "o",
                      color=_COLOURS[one["kind"]], ms=6, alpha=0.85, label=one["kind"])
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set(xlabel="frequency, Hz", ylabel="damping ratio", xlim=(0.0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")


def draw_showcase(figure: FigureBase, showcase: Showcase) -> None:
    """Draw bit and top over time, one panel for each controller."""
    every = figure.subplots(len(showcase.kinds), 1, sharex=True, squeeze=False)
    for row, kind in enumerate(showcase.kinds):
        axes = every[row][0]
        trace = showcase.trace
        axes.plot(trace.time_s, trace.bit_rad_s[:, row, 0] / RPM, color=_COLOURS[kind], lw=1.2, label=f"bit, {kind}")
        axes.plot(trace.time_s, trace.top_rad_s[:, row, 0] / RPM, color="0.45", lw=1.0, label="top drive")
        axes.set_ylabel("rpm")
        axes.grid(alpha=0.3)
        axes.margins(x=0.0)
        axes.legend(fontsize="small", loc="upper right")
    every[-1][0].set_xlabel("time, s")


__all__ = [
    "Interval", "Showcase", "TunedFor", "print_tuning", "showcase_of", "tuning_document", "tuning_report",
]
