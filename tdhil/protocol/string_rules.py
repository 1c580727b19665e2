"""What a drill string on the shaft forbids, looked at before anything moves (DESIGN.md, Stopping)."""

from __future__ import annotations

from drivers.drive import Preflight
from drivers.errors import PreflightRefused
from drivers.no_watchdog import FLAG, SHARED_FLAG
from tdhil.run.settings import ExcitationRequest, MachineLimits

_LETS_GO = ("coast", "none", "fault_reaction")
"""Reactions to a silent host after which nothing holds the string; a drive in fault has its torque off (CiA 402)."""


def refuse_by_plan(limits: MachineLimits, request: ExcitationRequest, lets_go: bool) -> None:
    """`refuse_with_string`, as far as it can be said with no drive at hand.

    ``lets_go``: the drive's profile says that it does after a quick stop.
    """
    if limits.load != "string":
        return
    if request.kind == "coast-down":
        raise PreflightRefused(
            "coast-down was asked for, and a drill string hangs on the shaft: it would turn the motor back",
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
    """PreflightRefused where torque could be lost while a string is wound up; nothing without a string."""
    if limits.load != "string":
        return
    refuse_by_plan(limits, request, lets_go=False)      # the drive itself is asked, after its watchdog
    if not preflight.watched:
        raise PreflightRefused(
            f"a drill string hangs on the shaft, and no watchdog is armed in the drive: {FLAG} is not for strings",
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
