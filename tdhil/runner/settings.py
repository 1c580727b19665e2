"""The limits of a run and its request: plain numbers, SI at the motor shaft."""

import signal
from dataclasses import dataclass, replace

from tdhil.config import DEFAULT_EXCITATION
from tdhil.errors import Interrupted

MEAN_SPEED_SHARES = 0.25, 0.7
"""Two mean speeds of the operating points of stage 2, as shares of the speed window."""

NOISE_SPEEDS = 5.0
"""Largest `MachineLimits.noise_scale_rad_s`, as a multiple of the highest speed of the run. Standstill is then 2.5 % of
that speed, and reverse rotation begins at 10 %."""


@dataclass(frozen=True)
class MachineLimits:
    """Limits of the machine, from rig.yaml. The guard enforces them, and the drive receives them too."""

    speed_min_rad_s: float             # lower edge of the window in which the excitation stays
    speed_max_rad_s: float             # upper edge; the guard trips on it
    torque_nm: float                   # largest magnitude of commanded torque
    time_s: float                      # the whole run from first motion to rest
    quick_stop_rad_s2: float = 2.0
    watchdog_s: float = 0.5
    probe_torque_nm: float = 0.0       # sign probe: torque may rise to this until the shaft moves
    probe_travel_rad: float = 3.0      # sign probe: longest travel of the shaft
    allow_reverse: bool = False
    load: str = "none"                 # none, string
    torque_ramp_nm_s: float = 0.0      # with a string: release rate of trapped torque
    wave_impedance_nm_s_rad: float = 0.0   # characteristic impedance of a string's pipe; 0: its sizes are unknown
    echo_s: float = 0.0                # round-trip time 2L/v of a wave; 0: unknown
    temperature_c: float | None = None     # °C; a drive that reports a temperature is stopped above it
    accept_no_watchdog: bool = False   # the operator accepts a drive that won't stop by itself (--accept-no-watchdog)
    accept_shared_watchdog: bool = False   # the operator accepts that any client feeds it (--accept-shared-watchdog)
    accept_speed_unit: bool = False    # the operator accepts the unit of speed unchecked (--accept-speed-unit)
    accept_wider: frozenset[str] = frozenset()     # own limits of the drive that the operator lets the run widen
    rig_speed_max_rad_s: float = 0.0   # limits.speed_max_rad_s, if this run has a lower one (--highest-speed); else 0

    @property
    def noise_scale_rad_s(self) -> float:
        """Return the speed whose shares count as noise of the reported speed, at standstill and in reverse.

        A lower highest speed of one run makes no report quieter.
        """
        return max(self.speed_max_rad_s, min(self.rig_speed_max_rad_s, NOISE_SPEEDS * self.speed_max_rad_s))

    @property
    def has_drill_string(self) -> bool:
        """Return whether a drill string is on the shaft."""
        return self.load == "string"


@dataclass(frozen=True)
class ExcitationRequest:
    """The request for stage 5; None = the default, scaled to the rig."""

    kind: str = DEFAULT_EXCITATION     # of `tdhil.config.registry.EXCITATIONS`
    mode: str | None = None            # torque, speed; None = torque if the drive has it
    frequency_hz: float | None = None
    amplitude_rad_s: float | None = None
    offset_rad_s: float | None = None
    periods: int | None = None
    realisations: int = 1              # sets of phases at each mean speed
    confidence: float = 0.95
    tolerance: float | None = None     # acquire until J's relative half-width is this; None = for a fixed time
    max_time_s: float | None = None    # longest stage 5; None = the plan's own, or what the time limit leaves
    impedance: str | None = None       # offset, reference: measure the drive's own impedance, in its speed loop
    string_nm_s_rad: float | None = None   # ζ of the string for the reported |r|, at the main shaft
    reference_filter_s: float = 0.0    # known filter time of the speed reference, s


@dataclass(frozen=True)
class ControlAssumptions:
    """Assumptions of the host's control and guard before the drive's reporting is known."""

    largest_speed_lag_s: float = 0.5   # largest plausible lag of the reported speed
    reaction_s: float = 0.1            # from a sample to the torque that responds to it
    smallest_inertia_share: float = 0.7    # smallest plausible J as a share of the rough J

    def at_period(self, period_s: float) -> "ControlAssumptions":
        """Return the assumptions for a cycle time. The response to a sample comes two cycles later at worst."""
        return replace(self, reaction_s=max(self.reaction_s, REACTION_CYCLES * period_s))


REACTION_CYCLES = 3.0
"""Cycles of a reaction: the sample's own cycle, the cycle of the response, and one that may be lost."""


class StopRequest:
    """A stop request, set by a signal handler or another thread in one assignment. The first cause is kept."""

    def __init__(self) -> None:
        self.signum: int | None = None
        self.why = ""
        self.count = 0

    def ask(self, signum: int = signal.SIGINT, why: str = "") -> None:
        """Request the stop. The run reads it in its next cycle, and ends as on that signal. ``why``: text."""
        self.count += 1
        if self.signum is None:
            self.why = why
            self.signum = int(signum)

    def check(self, *, next_step: str = "") -> None:
        """Raise Interrupted if a stop was requested."""
        if self.signum is not None:
            raise Interrupted(self.signum, self.why, next_step=next_step)
