"""In which mode of the drive a run goes: torque or speed, and what is refused because of it. Pure."""

from drivers.drive import Mode, Preflight
from drivers.errors import PreflightRefused
from tdhil.protocol.settings import ExcitationRequest, MachineLimits


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


def no_torque(wanted: str | None, preflight: Preflight) -> str:
    """Why the run is not in torque mode."""
    if Mode.TORQUE not in preflight.modes:
        return "the drive has no torque mode"
    if not preflight.switch_while_enabled:
        return "the drive can't enter torque mode while it turns"
    return "speed mode was asked for" if wanted == Mode.SPEED.value else "speed mode was chosen"
