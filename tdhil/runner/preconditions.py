"""In which mode of the drive a run goes, within which of its limits, and what is refused because of either. Pure."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from drivers import (
    ACCEPTED_BY,
    ANY_CLIENT,
    LOWER_THE_RATE,
    NO_WATCHDOG_FLAG,
    NOTHING_STOPS_IT,
    SHARED_FLAG,
    CommunicationLost,
    Mode,
    Paced,
    Preflight,
    PreflightRefused,
    ReportingFilters,
    Sample,
    quantile,
)
from drivers.own_limits import SPEED, TORQUE, WIDER_FLAG
from tdhil.config import DEFAULT_EXCITATION, told_before_echo
from tdhil.recording import LagPrior
from tdhil.runner.excitation import ECHOES_S, excitation_kind, tells_before_echo
from tdhil.runner.settings import ControlAssumptions, ExcitationRequest, MachineLimits

# ---------------------------------------------------------------------------------------------------------------------
# How many cycles a second: the profile's, or the next lower that this computer, its adapter and the drive hold.
#
# Tried before anything moves, with the drive disabled, by the cycles themselves: a computer that is busy, a slow
# adapter and a slow line show alike, in cycles that begin late and in answers that come late or not at all.


SHARE = 0.999
"""Of the cycles must be in time by half a period."""
CYCLES, LONGEST_S = 1000, 4.0
"""Tried at each rate: so many, or for so long where that is less."""
WARM_UP = 10
"""Cycles at each rate before those that count: the first ones load what was never needed before."""


@dataclass(frozen=True)
class Tried:
    """One rate: how many cycles it was tried for, how late ``SHARE`` of them were at most, and whether that will do."""

    rate_hz: float
    cycles: int
    late_s: float
    holds: bool

    @property
    def text(self) -> str:
        """As a person reads it."""
        return f"p99.9 of {1e3 * self.late_s:.2g} ms in {self.cycles} cycles"


@dataclass(frozen=True)
class RateChoice:
    """The rate that is left set, and what was tried before it, the highest first."""

    tried: tuple[Tried, ...]

    @property
    def taken(self) -> Tried:
        return self.tried[-1]

    @property
    def text(self) -> str:
        """One line for the terminal and the log."""
        taken, first = self.taken, self.tried[0]
        if not taken.holds:
            return (
                f"{taken.rate_hz:g} cycles a second, though this computer doesn't hold them ({taken.text}, "
                f"and half a period is {500.0 / taken.rate_hz:.3g} ms). {LOWER_THE_RATE}, or end what keeps it busy"
            )
        if taken is first:
            return f"{taken.rate_hz:g} cycles a second: this computer holds them ({taken.text}; --rate overrides)"
        return (
            f"{taken.rate_hz:g} cycles a second ({taken.text}) instead of the profile's {first.rate_hz:g}, which this "
            f"computer doesn't hold ({first.text}); --rate overrides, --real-time-priority may help"
        )

    def plain(self) -> list[dict[str, Any]]:
        """As the run's configuration keeps it."""
        return [asdict(one) for one in self.tried]


def quieten() -> None:
    """Whatever would hold a control loop up later is done now: before anything is armed, and before it is measured.

    Reading scipy from the disk takes seconds, in pieces that let no other thread run; and looking through all that is
    loaded, again and again, for garbage that isn't there takes a tenth of one.
    """
    import scipy.optimize
    import scipy.special  # noqa: F401

    import tdhil.estimation  # noqa: F401

    gc.collect()
    gc.freeze()


def choose_rate(drive: Paced, rates_hz: Sequence[float], cycle: Callable[[], Sample]) -> RateChoice:
    """Go down ``rates_hz`` until one holds; that one, or the last, is set. Raises whatever a cycle raises."""
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
# What is known of the lags in what a drive reports: from rig.yaml, the drive's own filters, and timing. Pure.


READ_FILTER_SD_SHARE = 0.1
READ_FILTER_SD_S = 0.001
"""How exactly a filter setting that the drive tells is the lag that it causes."""


def with_read_filters(prior: LagPrior, filters: ReportingFilters) -> LagPrior:
    """What rig.yaml states goes before what the drive tells of itself."""
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
    """Reports that are known to lag further than usual are reckoned with by guard, control and stop."""
    known_s = 0.0 if prior.speed_lag_s is None else prior.speed_lag_s + 2.0 * prior.speed_lag_sd_s
    return replace(assumptions, largest_speed_lag_s=max(assumptions.largest_speed_lag_s, known_s))


def with_timing(prior: LagPrior, half_width_s: float) -> LagPrior:
    """A sample's time may be off by so many seconds; torque and speed may be apart by as much."""
    return replace(prior, skew_sd_s=math.hypot(prior.skew_sd_s, half_width_s))


# ---------------------------------------------------------------------------------------------------------------------
# A run on a drive that is known not to watch its host, or not this one alone, which the operator has accepted by
# name.
#
# Everything else stays as it is: guard, limits and the stop are the host's and the drive's as ever. What changes is
# what may be said: nobody is to be told that the drive will stop the shaft by itself.


SAID = f"no watchdog is armed in the drive, {ACCEPTED_BY}: {NOTHING_STOPS_IT}"
SAID_SHARED = f"the drive's watchdog is no answer to a dead host, accepted by {SHARED_FLAG}: {ANY_CLIENT}"
_WARNING_SHARED = (
    f"the drive's watchdog was fed by any client, accepted by {SHARED_FLAG}: while another one went on asking, it would"
    " not have stopped by itself had this computer, the program or the cable failed"
)
_STEP_SHARED = (
    "If the shaft still turns, use the hard-wired emergency stop now: requests of any other client keep this drive's"
    f" watchdog from acting ({SHARED_FLAG}). Then check supply, cable and adapter"
)
_WARNING = (
    f"no watchdog was armed in the drive, {ACCEPTED_BY}: it would not have stopped by itself had this computer, the"
    " program or the cable failed"
)
_STEP = (
    f"If the shaft still turns, use the hard-wired emergency stop now: no watchdog is armed in this drive "
    f"({NO_WATCHDOG_FLAG})."
    " Then check supply, cable and adapter"
)


def configuration(preflight: Preflight) -> dict[str, Any]:
    """For the log, under `watchdog`; nothing where one is armed that this host alone feeds."""
    if preflight.watched and preflight.fed_by_any_client:
        return {"watchdog": {"armed": True, "fed_by_any_client": True, "accepted_by": SHARED_FLAG}}
    return {} if preflight.watched else {"watchdog": {"armed": False, "accepted_by": NO_WATCHDOG_FLAG}}


def precondition_warnings(run: Mapping[str, Any]) -> tuple[str, ...]:
    """For the result, from the log's configuration: the same live and replayed."""
    found = run.get("watchdog")
    if not isinstance(found, Mapping):
        return ()
    if found.get("fed_by_any_client") is True:
        return (_WARNING_SHARED,)
    return (_WARNING,) if found.get("armed") is False else ()


def correct(error: BaseException, preflight: Preflight | None) -> None:
    """Whoever can't reach the drive any more says that its watchdog acts; here none does."""
    if isinstance(error, CommunicationLost) and preflight is not None:
        if not preflight.watched:
            error.next_step = _STEP
        elif preflight.fed_by_any_client and not preflight.identity.simulated:
            error.next_step = _STEP_SHARED


# ---------------------------------------------------------------------------------------------------------------------
# What a drill string on the shaft forbids, looked at before anything moves (DESIGN.md, Stopping).


_LETS_GO = ("coast", "none", "fault_reaction")
"""Reactions to a silent host after which nothing holds the string; a drive in fault has its torque off (CiA 402)."""


def refuse_by_plan(limits: MachineLimits, request: ExcitationRequest, lets_go: bool) -> None:
    """`refuse_with_string`, as far as it can be said with no drive at hand.

    ``lets_go``: the drive's profile says that it does after a quick stop.
    """
    if told_before_echo(request.kind) and limits.wave_impedance_nm_s_rad <= 0.0:
        raise PreflightRefused(
            f"{request.kind} was asked for, which tells the inertia above a drill string whose pipe is known, and none"
            " is",
            where="--excitation and load in rig.yaml",
            next_step="Use --excitation multisine, or give load: {kind: string, length_m, outer_diameter_m,"
            " inner_diameter_m}",
        )
    if told_before_echo(request.kind) and not tells_before_echo(limits.echo_s):
        raise PreflightRefused(
            f"{request.kind} was asked for, and an echo comes back after {limits.echo_s:.2f} s: it tells those of"
            f" {ECHOES_S[0]:g} to {ECHOES_S[1]:g} s, of about 1100 to 6000 m of pipe",
            where="load.length_m in rig.yaml",
            next_step="Use --excitation multisine",
        )
    if not limits.winds_up:
        return
    if not excitation_kind(request.kind).with_string:
        raise PreflightRefused(
            f"{request.kind} was asked for, and a drill string hangs on the shaft: it would turn the motor back",
            where="--excitation",
            next_step="Use --excitation multisine",
        )
    if limits.torque_ramp_nm_s <= 0.0:
        raise PreflightRefused(
            "a drill string hangs on the shaft, and nothing says how fast its trapped torque is let go",
            where="torque_ramp_nm_s",
            next_step="Give torque_ramp_nm_s in rig.yaml, such as 50",
        )
    if lets_go:
        _refuse_quick_stop(holds=False)


def refuse_with_string(limits: MachineLimits, request: ExcitationRequest, preflight: Preflight) -> None:
    """PreflightRefused where torque could be lost while a string is wound up, or a string is missed."""
    refuse_by_plan(limits, request, lets_go=False)      # the drive itself is asked, after its watchdog
    if not limits.winds_up:
        return
    if not preflight.watched:
        raise PreflightRefused(
            "a drill string hangs on the shaft, and no watchdog is armed in the drive: "
            f"{NO_WATCHDOG_FLAG} is not for strings",
            where="load in rig.yaml",
            next_step="Only the drive's own stop is left for a wound-up string when the host fails: arm its watchdog",
        )
    if preflight.fed_by_any_client and not preflight.identity.simulated:
        raise PreflightRefused(
            f"a drill string hangs on the shaft, and any client feeds the drive's watchdog: {SHARED_FLAG} is not for"
            " strings",
            where="load in rig.yaml",
            next_step="Use a drive, or a setting of this one, whose watchdog only its commanding host feeds",
        )
    if preflight.safe_action in _LETS_GO:
        raise PreflightRefused(
            f"a drill string hangs on the shaft, and the drive's watchdog reaction is '{preflight.safe_action}':"
            " it would let go of the trapped torque",
            where="watchdog of the profile",
            next_step="Choose a reaction that brakes and holds: in CiA 402 object 6007h = 3 (quick stop)",
        )
    if not preflight.quick_stop_holds:
        _refuse_quick_stop(preflight.quick_stop_holds)


def _refuse_quick_stop(holds: bool | None) -> None:
    known = holds is not None
    raise PreflightRefused(
        "a drill string hangs on the shaft, and "
        + ("the drive lets go of it after a quick stop" if known
           else "nobody knows whether the drive holds it after a quick stop"),
        where="quick_stop of the profile",
        next_step="Use a drive that stays in quick stop (605Ah = 5 or 6), or run without the string"
        if known else "Look it up in the drive's manual, and write quick_stop.ends into a profile of your own",
    )


# ---------------------------------------------------------------------------------------------------------------------

def choose_mode(request: ExcitationRequest, limits: MachineLimits, preflight: Preflight) -> Mode:
    """Torque mode where the drive has it and can enter it while it turns, unless speed mode was asked for.

    Raises PreflightRefused where what was asked for can't be had in a mode of this drive.
    """
    if request.impedance is not None:
        _refuse_impedance(request, limits, preflight)
        return Mode.SPEED
    wanted, can_torque = request.mode, Mode.TORQUE in preflight.modes and preflight.switch_while_enabled
    if wanted == Mode.TORQUE.value and not can_torque:
        raise PreflightRefused(
            "torque mode was asked for, but this drive has none that can be entered while it turns",
            where="6502h and profile",
            next_step="Use --mode speed",
        )
    mode = Mode.SPEED if wanted == Mode.SPEED.value or not can_torque else Mode.TORQUE
    kind = excitation_kind(request.kind)
    if not kind.with_string and limits.load != "none":
        raise PreflightRefused(
            f"{request.kind} was asked for, but a {limits.load} hangs on the shaft and would drive it back",
            where="--excitation and load in rig.yaml",
            next_step="Use --excitation multisine",
        )
    if kind.needs_torque_mode and mode is Mode.SPEED:
        raise PreflightRefused(
            f"{request.kind} was asked for, but {no_torque(wanted, preflight)}: {kind.why_torque_mode}",
            where="--excitation",
            next_step="Use --excitation pulses or multisine",
        )
    return mode


def _refuse_impedance(request: ExcitationRequest, limits: MachineLimits, preflight: Preflight) -> None:
    """The drive's own impedance: in its speed loop, with nothing on the shaft, by a multisine."""
    if request.mode == Mode.TORQUE.value:
        raise PreflightRefused(
            "torque mode was asked for, and the drive's own impedance is that of its speed loop",
            where="--mode and --impedance", next_step="Leave --mode out",
        )
    if limits.load != "none":
        raise PreflightRefused(
            f"the drive's own impedance is measured with nothing on its shaft, and load is {limits.load}",
            where="--impedance and load in rig.yaml", next_step="Measure it before the string is below it",
        )
    if request.kind != DEFAULT_EXCITATION or request.frequency_hz is not None:
        raise PreflightRefused(
            "the lines that the drive's own impedance is measured at are the measurement's own",
            where="--impedance", next_step="Leave --excitation and --frequency out",
        )


SLOWEST_REFERENCE_S = 0.0125
"""Cycle above which a command's own delay is open by as much as the filters that are looked for."""


def refuse_slow_reference(request: ExcitationRequest, period_s: float) -> None:
    """PreflightRefused where a filter of the reference can't be told from a reference that comes in steps."""
    if request.impedance == "reference" and period_s > SLOWEST_REFERENCE_S:
        raise PreflightRefused(
            f"at {1.0 / period_s:.3g} cycles a second the reference comes in steps whose delay is open by"
            f" {1e3 * period_s:.0f} ms: a filter of the reference could not be told from it, and nothing would show",
            where="--impedance reference",
            next_step=f"It takes {1.0 / SLOWEST_REFERENCE_S:.0f} cycles a second or more",
        )


def keep_within(limits: MachineLimits, request: ExcitationRequest, preflight: Preflight) -> MachineLimits:
    """The rig's limits, or the drive's own where those were tighter and stayed (`drivers.own_limits`).

    Raises PreflightRefused where what was asked for, or the speed window itself, has no room in them.
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
        next_step=f"Ask for less, raise it at the drive, or let the run widen it: {WIDER_FLAG} {limit}",
    )


def no_torque(wanted: str | None, preflight: Preflight) -> str:
    """Why the run is not in torque mode."""
    if Mode.TORQUE not in preflight.modes:
        return "the drive has no torque mode"
    if not preflight.switch_while_enabled:
        return "the drive can't enter torque mode while it turns"
    return "speed mode was asked for" if wanted == Mode.SPEED.value else "speed mode was chosen"
