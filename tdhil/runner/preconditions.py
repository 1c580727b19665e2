"""The drive mode and the limits of a run, and the refusals that follow from them. Pure."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from drivers import (
    ACCEPTED_BY,
    ANY_CLIENT,
    LOWER_THE_RATE,
    NO_WATCHDOG_FLAG,
    NOTHING_STOPS_IT,
    SHARED_FLAG,
    Check,
    CommunicationLost,
    Mode,
    Outcome,
    Paced,
    Preflight,
    PreflightRefused,
    ReportingFilters,
    Sample,
    quantile,
)
from drivers.own_limits import SPEED, TORQUE, WIDER_FLAG
from profiles import CodedText, MessageCode
from tdhil.config import DEFAULT_EXCITATION, identified_before_echo
from tdhil.recording import LagPrior
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest, MachineLimits

# ---------------------------------------------------------------------------------------------------------------------
# The cycle rate: the profile's, or the next lower one that this computer, its adapter and the drive sustain.
#
# It is measured before motion, with the drive disabled, by the cycles themselves. A busy computer, a slow adapter and a
# slow line all show as cycles that begin late and replies that arrive late or not at all.


SHARE = 0.999
"""Share of the cycles that must be at most half a period late."""
CYCLES, LONGEST_S = 1000, 4.0
"""Test of each rate: number of cycles, or time in s if that is shorter."""
WARM_UP = 10
"""Cycles at each rate before the test: the first ones load modules."""


@dataclass(frozen=True)
class Tried:
    """The test of one rate: number of cycles, quantile ``SHARE`` of their lateness, and whether the rate holds."""

    rate_hz: float
    cycles: int
    late_s: float
    holds: bool

    @property
    def text(self) -> str:
        """Return the result as text."""
        return f"p99.9 of {1e3 * self.late_s:.2g} ms in {self.cycles} cycles"


@dataclass(frozen=True)
class RateChoice:
    """The chosen rate, and the rates tried before it, the highest first."""

    tried: tuple[Tried, ...]

    @property
    def taken(self) -> Tried:
        return self.tried[-1]

    @property
    def text(self) -> str:
        """Return one line for the terminal and the log."""
        taken, first = self.taken, self.tried[0]
        if not taken.holds:
            return (
                f"{taken.rate_hz:g} cycles per second, although this computer does not sustain them ({taken.text}; "
                f"the limit is half a period, {500.0 / taken.rate_hz:.3g} ms). {LOWER_THE_RATE}"
            )
        if taken is first:
            return f"{taken.rate_hz:g} cycles per second: this computer sustains them ({taken.text}; --rate overrides)"
        return (
            f"{taken.rate_hz:g} cycles per second ({taken.text}) instead of the profile's {first.rate_hz:g}, which"
            f" this computer does not sustain ({first.text}); --rate overrides, --real-time-priority may help"
        )

    def plain(self) -> list[dict[str, Any]]:
        """Return it as plain data for the run's configuration."""
        return [asdict(one) for one in self.tried]


def load_before_motion() -> None:
    """Load modules and collect garbage, before anything is armed and before the rate is measured.

    Reading scipy from the disk takes seconds, in pieces that block all other threads. Each garbage collection over all
    loaded objects takes a tenth of a second.
    """
    import scipy.optimize
    import scipy.special  # noqa: F401

    import tdhil.estimation  # noqa: F401

    gc.collect()
    gc.freeze()


def choose_rate(drive: Paced, rates_hz: Sequence[float], cycle: Callable[[], Sample]) -> RateChoice:
    """Try ``rates_hz`` in turn until one holds, and set it, or the last one. Raises what a cycle raises."""
    tried: list[Tried] = []
    for rate_hz in rates_hz:
        drive.set_rate(rate_hz, measuring=True)
        tried.append(_try(drive, rate_hz, cycle))
        if tried[-1].holds:
            break
    drive.set_rate(tried[-1].rate_hz)
    return RateChoice(tuple(tried))


def _try(drive: Paced, rate_hz: float, cycle: Callable[[], Sample]) -> Tried:
    half_s, planned = 0.5 / rate_hz, max(1, min(CYCLES, round(LONGEST_S * rate_hz)))
    may_be_late = planned - round(SHARE * planned)
    for _ in range(WARM_UP):
        cycle()
    late_s: list[float] = []
    late = 0
    while len(late_s) < planned and late <= may_be_late:
        answered = cycle().fresh
        late_s.append(max(drive.began_late_s, 0.0 if answered else 1.0 / rate_hz))
        late += late_s[-1] >= half_s
    return Tried(rate_hz, len(late_s), quantile(sorted(late_s), SHARE), late <= may_be_late)


# ---------------------------------------------------------------------------------------------------------------------
# Prior knowledge of the reporting lags: from rig.yaml, the drive's own filters, and timing. Pure.


READ_FILTER_SD_SHARE = 0.1   # of the filter time
READ_FILTER_SD_S = 0.001
"""Standard uncertainty of the lag that follows from a filter setting read from the drive (share, and s)."""


def with_read_filters(prior: LagPrior, filters: ReportingFilters) -> LagPrior:
    """Return the prior with the drive's filter settings. Values of rig.yaml take precedence."""
    speed, torque = prior.speed_lag_s, prior.torque_lag_s
    sources = [prior.source] if prior.source else []
    if speed is None and filters.speed_lag_s is not None:
        sd = READ_FILTER_SD_SHARE * filters.speed_lag_s + READ_FILTER_SD_S
        prior = replace(prior, speed_lag_s=filters.speed_lag_s, speed_lag_sd_s=sd)
    if torque is None and filters.torque_lag_s is not None:
        sd = READ_FILTER_SD_SHARE * filters.torque_lag_s + READ_FILTER_SD_S
        prior = replace(prior, torque_lag_s=filters.torque_lag_s, torque_lag_sd_s=sd)
    if filters.source:
        sources.append(filters.source)
    return replace(prior, source="; ".join(sources))


def with_known_lag(assumptions: ControlAssumptions, prior: LagPrior) -> ControlAssumptions:
    """Extend the assumed reporting lag of guard, control and stop if a longer one is known."""
    known_s = 0.0 if prior.speed_lag_s is None else prior.speed_lag_s + 2.0 * prior.speed_lag_sd_s
    return replace(assumptions, largest_speed_lag_s=max(assumptions.largest_speed_lag_s, known_s))


def with_timing(prior: LagPrior, half_width_s: float) -> LagPrior:
    """Widen the time offset between torque and speed by the uncertainty of the sample times."""
    return replace(prior, skew_sd_s=math.hypot(prior.skew_sd_s, half_width_s))


# ---------------------------------------------------------------------------------------------------------------------
# A run on a drive whose watchdog does not supervise this host, or not this host alone, accepted by name.
#
# Guard, limits and the stop stay the same. Only the texts change: none may state that the drive stops the shaft by
# itself.


SAID = f"no watchdog is armed in the drive, {ACCEPTED_BY}: {NOTHING_STOPS_IT}"
SAID_SHARED = f"the drive's watchdog may not detect a dead host, accepted by {SHARED_FLAG}: {ANY_CLIENT}"
_WARNING_SHARED = CodedText(
    f"the drive's watchdog was fed by any client, accepted by {SHARED_FLAG}: if another client had continued to send"
    " requests, it would not have stopped the shaft after a failure of this computer, the program or the cable",
    MessageCode.WATCHDOG_SHARED,
)
_STEP_SHARED = (
    "If the shaft still turns, use the hard-wired emergency stop now: requests of any other client keep this drive's"
    f" watchdog from acting ({SHARED_FLAG}). Then check supply, cable and adapter"
)
_WARNING = CodedText(
    f"no watchdog was armed in the drive, {ACCEPTED_BY}: it would not have stopped the shaft after a failure of this"
    " computer, the program or the cable",
    MessageCode.NO_WATCHDOG_ARMED,
)
_STEP = (
    f"If the shaft still turns, use the hard-wired emergency stop now: no watchdog is armed in this drive "
    f"({NO_WATCHDOG_FLAG})."
    " Then check supply, cable and adapter"
)


def configuration(preflight: Preflight) -> dict[str, Any]:
    """Return the log's `watchdog` entry; nothing if one is armed that only this host feeds."""
    if preflight.watched and preflight.fed_by_any_client:
        return {"watchdog": {"armed": True, "fed_by_any_client": True, "accepted_by": SHARED_FLAG}}
    return {} if preflight.watched else {"watchdog": {"armed": False, "accepted_by": NO_WATCHDOG_FLAG}}


def precondition_warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the warnings for the result, from the log's configuration: the same live and in replay."""
    found = run.get("watchdog")
    if not isinstance(found, Mapping):
        return ()
    if found.get("fed_by_any_client") is True:
        return (_WARNING_SHARED,)
    return (_WARNING,) if found.get("armed") is False else ()


def scales_taken_as_true(preflight: Preflight, *, calibrated: bool) -> Iterator[Check]:
    """Yield a row for each scale that no report of this drive can show to be wrong (`docs/explanation/stop.md`).

    ``calibrated``: a torque calibration is applied to the result.
    """
    if not calibrated:
        yield Check(
            "torque scale", "", "not checked: if all reports of torque have the same wrong scale, none contradicts"
            " another", Outcome.NOTE, "rated torque",
            "Calibrate the torque (tdhil calibrate torque): J is wrong by the same factor")
    if preflight.position_period_s is None:
        yield Check(
            "speed scale", "", "not checked: no position comes with the cycle", Outcome.NOTE, "speed report",
            "Compare the reported speed with the shaft's before you confirm it")


def correct(error: BaseException, preflight: Preflight | None) -> None:
    """Correct the next step of a lost connection: this drive has no watchdog that will act."""
    if isinstance(error, CommunicationLost) and preflight is not None:
        if not preflight.watched:
            error.next_step = _STEP
        elif preflight.fed_by_any_client and not preflight.identity.simulated:
            error.next_step = _STEP_SHARED


# ---------------------------------------------------------------------------------------------------------------------
# Refusals with a drill string on the shaft, checked before motion (DESIGN.md, Stopping).


_LETS_GO = ("coast", "none", "fault_reaction")
"""Watchdog reactions that release the string; a drive in fault switches its torque off (CiA 402)."""


def refuse_by_plan(limits: MachineLimits, request: ExcitationRequest, releases_after_stop: bool) -> None:
    """Raise PreflightRefused for refusals that need no drive, see `refuse_with_string`.

    ``releases_after_stop``: the drive is disabled after a quick stop, according to its profile.
    """
    from tdhil.runner.excitation import ECHOES_S, excitation_kind, leaves_time_before_echo

    if identified_before_echo(request.kind) and limits.wave_impedance_nm_s_rad <= 0.0:
        raise PreflightRefused(
            f"{request.kind} needs a drill string whose pipe is known, and rig.yaml describes no pipe",
            where="--excitation and load in rig.yaml",
            next_step="Use --excitation multisine, or give load: {kind: string, length_m, outer_diameter_m,"
            " inner_diameter_m}",
            entry=MessageCode.EXCITATION_NOT_POSSIBLE,
        )
    if identified_before_echo(request.kind) and not leaves_time_before_echo(limits.echo_s):
        raise PreflightRefused(
            f"{request.kind} needs an echo after {ECHOES_S[0]:g} to {ECHOES_S[1]:g} s (about 1100 to 6000 m of pipe);"
            f" the echo of this pipe returns after {limits.echo_s:.2f} s",
            where="load.length_m in rig.yaml",
            next_step="Use --excitation multisine",
            entry=MessageCode.EXCITATION_NOT_POSSIBLE,
        )
    if not limits.has_drill_string:
        return
    if not excitation_kind(request.kind).with_string:
        raise PreflightRefused(
            f"{request.kind} is not possible with a drill string on the shaft: the string would turn the motor back",
            where="--excitation",
            next_step="Use --excitation multisine",
            entry=MessageCode.EXCITATION_NOT_POSSIBLE,
        )
    if limits.torque_ramp_nm_s <= 0.0:
        raise PreflightRefused(
            "a drill string is on the shaft, and the release rate of its trapped torque is missing",
            where="torque_ramp_nm_s",
            next_step="Add torque_ramp_nm_s to rig.yaml, such as 50 (N·m/s)",
            entry=MessageCode.STRING_NOT_SAFE,
        )
    if releases_after_stop:
        _refuse_quick_stop(holds=False)


def refuse_with_string(limits: MachineLimits, request: ExcitationRequest, preflight: Preflight) -> None:
    """Raise PreflightRefused if a twisted string could lose its torque, or if a string is required and missing."""
    refuse_by_plan(limits, request, releases_after_stop=False)      # the value in the drive is checked below
    if not limits.has_drill_string:
        return
    if not preflight.watched:
        raise PreflightRefused(
            "a drill string is on the shaft, and no watchdog is armed in the drive: "
            f"{NO_WATCHDOG_FLAG} is not allowed with a string",
            where="load in rig.yaml",
            next_step="Arm the drive's watchdog: if the host fails, only the drive can stop a twisted string",
            entry=MessageCode.STRING_NOT_SAFE,
        )
    if preflight.fed_by_any_client and not preflight.identity.simulated:
        raise PreflightRefused(
            f"a drill string is on the shaft, and any client feeds the drive's watchdog: {SHARED_FLAG} is not allowed"
            " with a string",
            where="load in rig.yaml",
            next_step="Use a drive, or a setting of this one, whose watchdog only its commanding host feeds",
            entry=MessageCode.STRING_NOT_SAFE,
        )
    if preflight.safe_action in _LETS_GO:
        raise PreflightRefused(
            f"a drill string is on the shaft, and the drive's watchdog reaction is '{preflight.safe_action}':"
            " it would release the trapped torque at once",
            where="watchdog of the profile",
            next_step="Choose a reaction that brakes and holds: in CiA 402 object 6007h = 3 (quick stop)",
            entry=MessageCode.STRING_NOT_SAFE,
        )
    if not preflight.quick_stop_holds:
        _refuse_quick_stop(preflight.quick_stop_holds)


def _refuse_quick_stop(holds: bool | None) -> None:
    known = holds is not None
    raise PreflightRefused(
        "a drill string is on the shaft, and "
        + ("the drive is disabled after a quick stop and would release it" if known
           else "it is unknown whether the drive holds it after a quick stop"),
        where="quick_stop of the profile",
        next_step="Use a drive that stays in quick stop (605Ah = 5 or 6), or run without the string"
        if known else "Look it up in the drive's manual, and set quick_stop.ends in your own profile",
        entry=MessageCode.STRING_NOT_SAFE,
    )


# ---------------------------------------------------------------------------------------------------------------------

def choose_mode(request: ExcitationRequest, limits: MachineLimits, preflight: Preflight) -> Mode:
    """Return torque mode if the drive can enter it while it turns, unless speed mode is requested.

    Raises PreflightRefused if the drive has no mode for the requested motion.
    """
    from tdhil.runner.excitation import excitation_kind

    if request.impedance is not None:
        _refuse_impedance(request, limits, preflight)
        return Mode.SPEED
    wanted, obstacle = request.mode, _torque_obstacle(limits, preflight)
    can_torque = not obstacle
    if wanted == Mode.TORQUE.value and obstacle:
        raise PreflightRefused(
            f"torque mode is requested, but {obstacle}",
            where="modes and quick_stop of the profile",
            next_step="Use --mode speed",
            entry=MessageCode.NO_TORQUE_MODE,
        )
    mode = Mode.SPEED if wanted == Mode.SPEED.value or not can_torque else Mode.TORQUE
    kind = excitation_kind(request.kind)
    if not kind.with_string and limits.load != "none":
        raise PreflightRefused(
            f"{request.kind} is requested, but a {limits.load} is on the shaft and would drive it back",
            where="--excitation and load in rig.yaml",
            next_step="Use --excitation multisine",
            entry=MessageCode.EXCITATION_NOT_POSSIBLE,
        )
    if kind.needs_torque_mode and mode is Mode.SPEED:
        raise PreflightRefused(
            f"{request.kind} is requested, but {no_torque(wanted, limits, preflight)}: {kind.why_torque_mode}",
            where="--excitation",
            next_step="Use --excitation pulses or multisine",
            entry=MessageCode.EXCITATION_NOT_POSSIBLE,
        )
    return mode


def _refuse_impedance(request: ExcitationRequest, limits: MachineLimits, preflight: Preflight) -> None:
    """Refuse an impedance measurement outside the speed loop, with a load, or with another excitation."""
    if request.mode == Mode.TORQUE.value:
        raise PreflightRefused(
            "torque mode is requested, but the drive's own impedance is measured in its speed loop",
            where="--mode and --impedance", next_step="Remove --mode",
            entry=MessageCode.IMPEDANCE_NOT_POSSIBLE,
        )
    if limits.load != "none":
        raise PreflightRefused(
            f"the drive's own impedance is measured without a load, but load is {limits.load}",
            where="--impedance and load in rig.yaml", next_step="Measure it before the string is connected",
            entry=MessageCode.IMPEDANCE_NOT_POSSIBLE,
        )
    if request.kind != DEFAULT_EXCITATION or request.frequency_hz is not None:
        raise PreflightRefused(
            "the measurement of the drive's own impedance chooses its excited frequencies itself",
            where="--impedance", next_step="Remove --excitation and --frequency",
            entry=MessageCode.IMPEDANCE_NOT_POSSIBLE,
        )


SLOWEST_REFERENCE_S = 0.0125
"""Longest cycle, s. Above it the delay of a setpoint is as uncertain as the filters to be identified."""


def refuse_slow_reference(request: ExcitationRequest, period_s: float) -> None:
    """Raise PreflightRefused if the cycle is too slow to identify a filter of the reference."""
    if request.impedance == "reference" and period_s > SLOWEST_REFERENCE_S:
        raise PreflightRefused(
            f"at {1.0 / period_s:.3g} cycles per second the delay of the reference is uncertain by"
            f" {1e3 * period_s:.0f} ms: a filter of the reference could not be identified",
            where="--impedance reference",
            next_step=f"Use {1.0 / SLOWEST_REFERENCE_S:.0f} cycles per second or more",
            entry=MessageCode.IMPEDANCE_NOT_POSSIBLE,
        )


def keep_within(limits: MachineLimits, request: ExcitationRequest, preflight: Preflight) -> MachineLimits:
    """Return the rig's limits, or the drive's own if those are tighter and kept (`drivers.own_limits`).

    Raises PreflightRefused if the requested motion, or the speed window itself, does not fit in them.
    """
    torque_nm, speed_rad_s = preflight.kept_torque_nm, preflight.kept_speed_rad_s
    if torque_nm is not None:
        if torque_nm <= 0.0:
            raise _no_room(f"the drive's own torque limit is {torque_nm:g} N·m", TORQUE)
        limits = replace(
            limits,
            torque_nm=min(limits.torque_nm, torque_nm),
            probe_torque_nm=min(limits.probe_torque_nm, torque_nm),
        )
    if speed_rad_s is not None:
        highest = (request.offset_rad_s or 0.0) + (request.amplitude_rad_s or 0.0)
        if speed_rad_s <= max(limits.speed_min_rad_s, highest):
            asked = f"{highest:g} rad/s" if highest > limits.speed_min_rad_s else f"{limits.speed_min_rad_s:g} rad/s"
            raise _no_room(f"the drive's own speed limit is {speed_rad_s:.4g} rad/s, and the run needs {asked}", SPEED)
        limits = replace(limits, speed_max_rad_s=min(limits.speed_max_rad_s, speed_rad_s))
    return limits


def _no_room(what: str, limit: str) -> PreflightRefused:
    return PreflightRefused(
        what, where="drive's own limit",
        next_step=f"Request less, raise the limit in the drive, or let the run widen it: {WIDER_FLAG} {limit}",
        entry=MessageCode.DRIVE_LIMIT_TIGHTER,
    )


def stops_from_torque_mode(limits: MachineLimits, quick_stop_brakes: bool) -> bool:
    """Return whether a run in torque mode can be stopped above its load.

    ``quick_stop_brakes``: the profile promises that a quick stop brakes in torque mode. Without this promise, a host
    can request speed mode before it stops, but the drive's watchdog cannot: it may remove the torque at once. The
    string then unwinds and drives the shaft.
    """
    return not limits.has_drill_string or quick_stop_brakes


def _torque_obstacle(limits: MachineLimits, preflight: Preflight) -> str:
    """Return why the drive cannot use torque mode in this run; an empty text if it can."""
    if Mode.TORQUE not in preflight.modes:
        return "the drive has no torque mode"
    if not preflight.switch_while_enabled:
        return "the drive can't enter torque mode while it turns"
    if not stops_from_torque_mode(limits, preflight.quick_stop_in_torque_mode):
        return (
            "if this host fails above a drill string, the drive must brake in torque mode, and its profile does not"
            " promise that: the torque could be removed at once, and the string would unwind"
        )
    return ""


def no_torque(wanted: str | None, limits: MachineLimits, preflight: Preflight) -> str:
    """Return why the run is not in torque mode."""
    return _torque_obstacle(limits, preflight) or (
        "speed mode is requested" if wanted == Mode.SPEED.value else "speed mode was chosen")
