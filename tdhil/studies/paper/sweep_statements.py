"""Statements of section 3.4 on figures 9, 10, 12 and 13, and whether tdhil confirms them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from math import pi

from tdhil.studies.paper.sweeps import SweepPoint, SweepSettings
from tdhil.studies.study import Statement


def grows(values: Sequence[float]) -> bool:
    """Return whether each value is larger than the one before."""
    return all(later > earlier for earlier, later in pairwise(values))


def falls(values: Sequence[float]) -> bool:
    """Return whether each value is smaller than the one before."""
    return grows([-value for value in values])


def _row(points: Sequence[SweepPoint], name: str, digits: int = 3) -> str:
    return ", ".join(f"{getattr(point.response, name):.{digits}f}" for point in _sorted(points))


def _sorted(points: Sequence[SweepPoint]) -> list[SweepPoint]:
    return sorted(points, key=lambda point: point.value)


def _column(points: Sequence[SweepPoint], name: str) -> list[float]:
    return [getattr(point.response, name) for point in _sorted(points)]


def _lag_moves(points: Sequence[SweepPoint], *, up: bool) -> bool:
    """Return whether the lag changes in this direction by both methods of measurement."""
    moves = grows if up else falls
    return moves(_column(points, "lag_fundamental_deg")) and moves(_column(points, "lag_zeros_deg"))


def _lags(points: Sequence[SweepPoint]) -> str:
    return f"{_row(points, 'lag_fundamental_deg', 1)}° (zero crossing: {_row(points, 'lag_zeros_deg', 1)}°)"


def figure9(settings: SweepSettings, points: list[SweepPoint]) -> tuple[Statement, ...]:
    """Return the statements on figure 9, over inertia."""
    return (
        Statement(
            "amplitude attenuation grows monotonically with J", "section 3.4.1, figure 9b",
            f"A_in − A_out = {_row(points, 'amplitude_difference_rad_s')} rad/s",
            grows(_column(points, "amplitude_difference_rad_s")),
        ),
        Statement(
            "phase lag grows monotonically with J",
            "section 3.4.1, figure 9c", _lags(points), _lag_moves(points, up=True)
        ),
        Statement(
            "gain is G = A_in/A_out (equation 12)",
            "printed so; but a lagging sine is given 0.96, and attenuation is called loss",
            "A_out/A_in throughout: the printed fraction is upside down", None,
        ),
        Statement(
            "P, I, frequency and amplitude of the figure", "'tuned to a stable state', not printed",
            f"P {settings.kp_nm_s_rad:g}, I {settings.ki_nm_rad:g}, {settings.frequency_hz:g} Hz, "
            f"{settings.amplitude_rad_s:g} rad/s: "
            "the defaults are inferred from figure 11; the shape is reproduced, no numbers are claimed", None,
        ),
    )


def figure10(settings: SweepSettings, points: list[SweepPoint]) -> tuple[Statement, ...]:
    """Return the statements on figure 10, over frequency."""
    gains = _column(points, "gain_fundamental")
    peak = gains.index(max(gains))
    inertia, kp, ki, viscous = (
        settings.inertia_kg_m2, settings.kp_nm_s_rad, settings.ki_nm_rad, settings.viscous_nm_s_rad
    )
    square = (2.0 * ki * inertia - 2.0 * kp * viscous - viscous**2) / inertia**2
    above = f"below {square**0.5 / (2.0 * pi):.2f} Hz" if square > 0.0 else "nowhere"
    return (
        Statement(
            "low-pass: low frequencies are followed, high ones attenuated", "section 3.4.2, figure 10",
            f"gain {_row(points, 'gain')}: within {100 * abs(gains[0] - 1):.0f} % of 1 at the lowest, "
            f"{gains[-1]:.2f} at the highest",
            abs(gains[0] - 1.0) < 0.05 and gains[-1] < 0.95 * gains[0] and falls(gains[peak:]),
        ),
        Statement(
            "the output amplitude falls with every rise in frequency", "section 3.4.2, P and I not printed",
            f"it falls above {_sorted(points)[peak].value:g} Hz. |G|² − 1 has the sign of 2KiJ − 2KpB − B² − "
            "J²w²: with these P and I the "
            f"gain is above 1 {above}, largest {max(gains):.3f}",
            True if peak == 0 and falls(gains) else None,
        ),
        Statement("phase lag grows with frequency", "section 3.4.2", _lags(points), _lag_moves(points, up=True)),
    )


def figure12(_settings: SweepSettings, points: list[SweepPoint]) -> tuple[Statement, ...]:
    """Return the statements on figure 12, over proportional gain."""
    gains = _column(points, "gain")
    return (
        Statement("gain grows with P", "section 3.4.4, figure 12", f"gain {_row(points, 'gain')}", grows(gains)),
        Statement("phase difference falls as P grows", "section 3.4.4", _lags(points), _lag_moves(points, up=False)),
    )


def figure13(_settings: SweepSettings, points: list[SweepPoint]) -> tuple[Statement, ...]:
    """Return the statements on figure 13, over integral gain."""
    short = [abs(one) for one in _column(points, "amplitude_difference_rad_s")]
    return (
        Statement(
            "the output amplitude comes nearer to the input's as I grows", "section 3.4.4, figure 13",
            f"A_in − A_out = {_row(points, 'amplitude_difference_rad_s')} rad/s", falls(short),
        ),
        Statement("phase lag grows with I", "section 3.4.4", _lags(points), _lag_moves(points, up=True)),
        Statement(
            "I reduces the steady-state error", "section 3.4.4, of the amplitude of a sine",
            "of a constant speed the error is zero with any I above 0; what falls here is the amplitude error "
            "at this frequency",
            None,
        ),
    )
