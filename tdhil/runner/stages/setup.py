"""Stage 1, setup: offsets at standstill, and the sign probe. Connecting and preflight come before it.

The probe ramps torque until the shaft moves or the probe limit is reached, forward only and over a limited
travel. A drive whose torque and speed disagree in sign would run away in torque mode; the probe detects this
at very low speed.
"""

from __future__ import annotations

from collections import deque

from drivers import Command, LimitHit, Mode, PreflightRefused
from profiles import MessageCode
from tdhil.runner.control_loop import ControlLoop
from tdhil.runner.settings import MachineLimits
from tdhil.runner.stages.steady import trace

STANDSTILL_S = 1.0        # s; averaging time of the offsets at standstill
RAMP_S = 5.0
"""Time to reach the probe torque, if nothing moves before, s."""
TORQUE_SEEN_S = 0.5
"""Time, s, after which a torque above the probe's ends the probe in speed mode; time of zero torque at its end."""


def measure_torque_offset(loop: ControlLoop, at_rest_rad_s: float) -> float:
    """Return the mean reported torque at standstill, N·m. Raises PreflightRefused if the shaft turns.

    ``at_rest_rad_s``: highest speed that counts as standstill (`tdhil.runner.standstill`), rad/s.
    """
    held = trace(loop.hold(Command(Mode.SPEED, 0.0, 0.0), STANDSTILL_S))
    if len(held.time_s) == 0:
        raise PreflightRefused("no feedback from the drive", where="TPDO1",
                               next_step="Check that the node is operational", entry=MessageCode.NO_FEEDBACK)
    speed = float(held.speed_rad_s.mean())
    rate_rad_s = loop.guard.observer.rate_rad_s
    by_position = "" if rate_rad_s is None else f" ({rate_rad_s:.3f} rad/s by its position)"
    if abs(speed) > at_rest_rad_s or not loop.guard.observer.angle_quiet(at_rest_rad_s):
        raise PreflightRefused(
            f"the shaft already turns: speed {speed:.3f} rad/s{by_position}, and at most {at_rest_rad_s:.3g} rad/s is"
            " standstill", where="setup",
            next_step="Bring it to standstill first, or correct the offset of the reported speed",
            entry=MessageCode.SHAFT_TURNS,
        )
    return float(held.torque_nm.mean())


def probe_sign(loop: ControlLoop, limits: MachineLimits, mode: Mode, speed_resolution_rad_s: float) -> float | None:
    """Move the shaft a little. Return the torque at which it moved (None in speed mode).

    Raises PreflightRefused when it turns the wrong way, or not at all.
    """
    threshold_rad_s = max(6.0 * speed_resolution_rad_s, 0.01 * limits.speed_max_rad_s)
    recent: deque[float] = deque(maxlen=loop.cycles(0.1))
    travel_rad = 0.0
    torque_nm = speed_rad_s = highest_nm = 0.0
    ramped = strained = 0
    above = False           # the torque of the last cycle, in speed mode, over the limit of the probe
    before_s = loop.enable(mode, Command(mode, 0.0, 0.0)).time_s
    for _ in range(loop.cycles(RAMP_S + 2.0)):
        ramped += not above
        share = min(1.0, ramped * loop.period_s / RAMP_S)
        if mode is Mode.TORQUE:
            torque_nm = share * limits.probe_torque_nm
        else:
            speed_rad_s = share * 0.1 * limits.speed_max_rad_s
        try:
            sample = loop.cycle(Command(mode, speed_rad_s, torque_nm))
        except LimitHit as error:
            if recent and sum(recent) < 0.0:
                loop.guard.observer.backwards = True
                raise _wrong_way(sum(recent) / len(recent)) from error
            raise
        recent.append(sample.speed_rad_s)
        mean_rad_s = sum(recent) / len(recent)
        travel_rad += sample.speed_rad_s * (sample.time_s - before_s)
        before_s = sample.time_s
        if mean_rad_s < -threshold_rad_s:
            loop.guard.observer.backwards = True
            raise _wrong_way(mean_rad_s)
        if mean_rad_s > threshold_rad_s:
            return torque_nm if mode is Mode.TORQUE else None
        # In speed mode the drive itself raises the torque. Above the limit of the probe the set speed does not rise,
        # and the probe ends if the shaft is not seen to move within a short time.
        above = mode is Mode.SPEED and abs(sample.torque_nm) > limits.probe_torque_nm > 0.0
        if above:
            highest_nm = max(highest_nm, abs(sample.torque_nm))
            strained += 1
            if strained >= loop.cycles(TORQUE_SEEN_S):
                break
        if abs(travel_rad) > limits.probe_travel_rad:
            _end_torque(loop, mode)
            raise PreflightRefused(
                f"the shaft moved {travel_rad:.2f} rad without a clear direction, the limit is"
                f" {limits.probe_travel_rad:g} rad", where="sign probe",
                next_step="Check the speed signal for noise and wrong scale",
                entry=MessageCode.SIGN_NOT_CLEAR,
            )
    _end_torque(loop, mode)
    to_release = "Check that the brake is released, or raise limits.probe_torque_nm in rig.yaml"
    if mode is Mode.TORQUE:
        what, next_step = f"the shaft did not move up to the limit of {limits.probe_torque_nm:g} N·m", to_release
    elif above:
        what = (f"the drive's torque rose to {highest_nm:.0f} N·m, above limits.probe_torque_nm of"
                f" {limits.probe_torque_nm:g} N·m, before the shaft turned at {threshold_rad_s:.3g} rad/s")
        next_step = to_release
    else:
        what = f"the shaft did not follow a speed of {speed_rad_s:.3f} rad/s"
        next_step = "Check the brake, the drive's enable input, and that its lowest speed is below this one"
    raise PreflightRefused(what, where="sign probe", next_step=next_step, entry=MessageCode.SHAFT_DID_NOT_MOVE)


def _end_torque(loop: ControlLoop, mode: Mode) -> None:
    """Command zero torque before the stop: its speed control would continue with the flowing torque."""
    if mode is Mode.TORQUE:
        loop.hold(Command(Mode.TORQUE, 0.0, 0.0), TORQUE_SEEN_S)


def _wrong_way(speed_rad_s: float) -> PreflightRefused:
    return PreflightRefused(
        f"the shaft turned backwards ({speed_rad_s:.3f} rad/s) on a forward command", where="sign probe",
        next_step="The sign of speed or torque is inverted: check encoder wiring and the drive's direction settings",
        entry=MessageCode.DIRECTION_WRONG,
    )
