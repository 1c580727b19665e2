"""In which mode of the drive a run goes, within which of its limits, and what is refused because of either. Pure."""

from dataclasses import replace

from drivers.drive import Mode, Preflight
from drivers.errors import PreflightRefused
from drivers.own_limits import FLAG, SPEED, TORQUE
from tdhil.run.settings import ExcitationRequest, MachineLimits


def choose_mode(request: ExcitationRequest, limits: MachineLimits, preflight: Preflight) -> Mode:
    """Torque mode where the drive has it and can enter it while it turns, unless speed mode was asked for.

    Raises PreflightRefused where what was asked for can't be had in a mode of this drive.
    """
    wanted, can_torque = request.mode, Mode.TORQUE in preflight.modes and preflight.switch_while_enabled
    if wanted == Mode.TORQUE.value and not can_torque:
        raise PreflightRefused(
            "torque mode was asked for, but this drive has none that can be entered while it turns",
            where="6502h and profile",
            next_step="Use --mode speed",
        )
    mode = Mode.SPEED if wanted == Mode.SPEED.value or not can_torque else Mode.TORQUE
    if request.kind == "coast-down" and limits.load != "none":
        raise PreflightRefused(
            f"coast-down was asked for, but a {limits.load} hangs on the shaft and would drive it back",
            where="--excitation and load in rig.yaml",
            next_step="Use --excitation multisine",
        )
    if request.kind == "coast-down" and mode is Mode.SPEED:
        raise PreflightRefused(
            f"coast-down was asked for, but {no_torque(wanted, preflight)}: a shaft under speed control never coasts",
            where="--excitation",
            next_step="Use --excitation pulses or multisine",
        )
    return mode


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
        next_step=f"Ask for less, raise it at the drive, or let the run widen it: {FLAG} {limit}",
    )


def no_torque(wanted: str | None, preflight: Preflight) -> str:
    """Why the run is not in torque mode."""
    if Mode.TORQUE not in preflight.modes:
        return "the drive has no torque mode"
    if not preflight.switch_while_enabled:
        return "the drive can't enter torque mode while it turns"
    return "speed mode was asked for" if wanted == Mode.SPEED.value else "speed mode was chosen"
