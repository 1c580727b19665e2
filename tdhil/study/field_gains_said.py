"""What figures 20 and 21 claim, and whether it holds here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tdhil.recording.recording import FloatArray
from tdhil.studies.field.settings import GainSweepSettings
from tdhil.studies.field.tone import Amplitudes
from tdhil.studies.study import Statement
from tdhil.study.field_loop import best_kp, gain, tones_with_steady_rise


def said_of_kp(settings: GainSweepSettings, values: Sequence[float], found: Sequence[Amplitudes]) -> tuple[
    Statement, ...
]:
    """Figure 20: first falling, then rising, least at 300."""
    away = _away(found)
    best = int(np.argmin(away))
    valley = 0 < best < len(away) - 1 and bool(np.all(np.diff(away[: best + 1]) < 0.0) and np.all(
        np.diff(away[best:]) > 0.0))
    tone, rig = settings.frequency_hz, settings.rig
    low, high = min(values), max(values)
    elsewhere = ", ".join(
        f"{_edge(best_kp(rig, hertz, settings.ki_nm_rad, low, high), low, high)} at {hertz:g} Hz"
        for hertz in settings.other_tones_hz
        if hertz != tone
    )
    own = gain(rig, tone, np.asarray(values), settings.ki_nm_rad, reported=False)
    shaft = settings.amplitude_rad_s * np.abs(own - 1.0)
    return (
        Statement(
            "the difference of the amplitudes first falls, then rises with P", "from 150 to 1500",
            f"{away[0]:.3f} rad/s at {values[0]:g}, {away[best]:.4f} at {values[best]:g}, {away[-1]:.3f} at "
            f"{values[-1]:g}; {tone:g} Hz, I {settings.ki_nm_rad:g}",
            valley,
        ),
        Statement(
            "it is least at P = 300", "300; tone, I and input amplitude are not given",
            f"{values[best]:g} at {tone:g} Hz; but {elsewhere} (linear loop): the tone makes it, and it is not known",
            None,
        ),
        Statement(
            "P = 300 is the best balance of response and tracking", "taken from the minimum",
            f"the shaft itself follows ever better with P ({shaft[0]:.3f} to {shaft[-1]:.3f} rad/s, linear loop); the "
            "minimum is where overshoot and the lag of the reported speed cancel",
            bool(np.argmin(shaft) == best),
        ),
    )


def said_of_ki(settings: GainSweepSettings, values: Sequence[float], found: Sequence[Amplitudes]) -> tuple[
    Statement, ...
]:
    """Figure 21: rising throughout, least at 200."""
    away = _away(found)
    best, worst = int(np.argmin(away)), int(np.argmax(away))
    steady = bool(np.all(np.diff(away) > 0.0))
    tone = settings.frequency_hz
    some, tones = tones_with_steady_rise(settings.rig, settings.kp_nm_s_rad, tuple(values))
    shape = "rises throughout" if steady else (
        f"rises to {away[worst]:.3f} rad/s at I = {values[worst]:g}, then falls again as the loop's resonance leaves "
        f"the tone behind; of {tones} tones from 0.05 to 1 Hz {some or 'none'} would give a steady rise (linear loop, "
        f"P {settings.kp_nm_s_rad:g})"
    )
    return (
        Statement(
            "the difference of the amplitudes is least at the lowest I", "I = 200",
            f"{away[best]:.4f} rad/s at I = {values[best]:g}; {tone:g} Hz, P {settings.kp_nm_s_rad:g}", best == 0,
        ),
        Statement(
            "it first grows with I", "'an increase trend'",
            f"from {away[0]:.3f} to {away[worst]:.3f} rad/s between I = {values[0]:g} and {values[worst]:g}",
            worst > 0 and bool(np.all(np.diff(away[: worst + 1]) > 0.0)),
        ),
        Statement("and goes on growing up to 2500", "'an increase trend' from 200 to 2500", shape,
                  True if steady else None),
        Statement(
            "it is 0.0594 rad/s at I = 200", "0.0594; tone, P and input amplitude are not given",
            f"{away[0]:.4f} rad/s for an input of {settings.amplitude_rad_s:g}; no number is claimed", None,
        ),
        Statement(
            "figure 21's trend is similar to figure 20's", "said of both, one falling first, one rising throughout",
            "the two descriptions exclude each other", None,
        ),
    )


def _away(found: Sequence[Amplitudes]) -> FloatArray:
    return np.array([abs(one.difference_rad_s) for one in found])


def _edge(value: float, low: float, high: float) -> str:
    """The minimum's place, or that it lies outside."""
    if value <= 1.001 * low:
        return f"at or below {low:g}"
    return f"at or above {high:g}" if value >= 0.999 * high else f"{value:.0f}"
