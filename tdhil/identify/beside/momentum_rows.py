"""One balance of momentum, between two instants at which no reporting lag matters.

A knot is a short window in which speed is read; a row is what happened between one knot and the next. With w(t) rising
from 0 to 1 over the first knot and falling back over the second, J ω̇ = T − B ω − T_c sgn ω − d integrates by parts to

    ∫w T = J Δω + B ∫w ω + T_c ∫w sgn ω + ∫w d,        Δx = ∫w ẋ = mean over the second knot − mean over the first.

Reports: T_rep = T − τ_T Ṫ + …, ω_rep = ω − τ_w ω̇ + …, for filters of any kind with delays τ_T and τ_w. Put in, with
Ṫ = J ω̈ + B ω̇ + ḋ and δ = τ_w − τ_T, to first order

    ∫w T_rep = J (Δω_rep + δ Δα) + B (∫w ω_rep + δ Δω_rep) + T_c ∫w sgn ω + ∫w d.

At calm knots Δα is next to nothing, and so are the terms of higher order, whatever the filters: of everything unknown
in the reports only B δ is left, some percent of J. Over a knot of one whole period of a periodic motion Δα is nothing.
A coasting shaft obeys a linear equation without torque, of which every filtered speed is a solution as well: δ = 0.

The disturbance d is taken as white of density D, (N·m)²·s: row i has variance D ∫w_i², and neighbours that share a knot
of length a covary by D a/6, since ∫ u (1 − u) du = 1/6.
"""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.recording.recording import FloatArray

_LONGEST_GAP_S = 0.3
_CHUNK = 65_536           # samples worked on at once: a long row never stands in memory as a whole


class Kind(Enum):
    """What a row is for."""

    TURNING = "turning"       # steady or changing speed under torque
    COASTING = "coasting"


@dataclass(frozen=True)
class Knot:
    """A window in which speed is read; ``periodic``: one whole period of an excitation."""

    start_s: float
    end_s: float
    periodic: bool = False
    coasting: bool = False

    @property
    def length_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True)
class Row:
    """One balance: integrals over w(t). Speeds rad/s, times s, torque impulse N·m·s; ``energy_s`` is ∫w²."""

    first: Knot
    second: Knot
    kind: Kind
    change_rad_s: float
    change_rad_s2: float
    travel_rad: float         # ∫w ω
    time_s: float             # ∫w
    impulse_nm_s: float       # ∫w T
    energy_s: float


def balance(samples: Samples, first: Knot, second: Knot) -> Row | None:
    """The row from one knot to the next; None where samples are missing."""
    begin, end = (int(i) for i in np.searchsorted(samples.time_s, (first.start_s - 1e-9, second.end_s - 1e-9)))
    if end - begin < 8:
        return None
    readings = [_reading(samples, knot) for knot in (first, second)]
    totals = np.zeros(3)
    for at in range(begin, end, _CHUNK):
        part = slice(at, min(at + _CHUNK, end))
        time, cells, longest = _cells(samples.time_s, part)
        if longest > _LONGEST_GAP_S:
            return None
        weight = np.minimum((time - first.start_s) / first.length_s, (second.end_s - time) / second.length_s)
        weight = np.clip(weight, 0.0, 1.0) * cells
        totals += np.sum(weight), weight @ samples.speed_rad_s[part], weight @ samples.torque_nm[part]
    if None in readings or not float(totals[0]) > 0.0:
        return None
    (mean_a, slope_a), (mean_b, slope_b) = (reading for reading in readings if reading is not None)
    middle = second.start_s - first.end_s
    return Row(
        first,
        second,
        Kind.COASTING if first.coasting and second.coasting else Kind.TURNING,
        change_rad_s=mean_b - mean_a,
        change_rad_s2=slope_b - slope_a,
        travel_rad=float(totals[1]),
        time_s=float(totals[0]),
        impulse_nm_s=float(totals[2]),
        energy_s=middle + (first.length_s + second.length_s) / 3.0,
    )


def _cells(time_s: FloatArray, part: slice) -> tuple[FloatArray, FloatArray, float]:
    """Times of some samples, how long each stands for (half of the way to either neighbour), and the widest gap."""
    low, high = max(part.start - 1, 0), min(part.stop + 1, len(time_s))
    gaps = np.diff(time_s[low:high])
    before = gaps[: part.stop - part.start] if low < part.start else np.append(0.0, gaps)[: part.stop - part.start]
    after = gaps[part.start - low :]
    after = after if high > part.stop else np.append(after, 0.0)
    return time_s[part], 0.5 * (before + after), float(np.max(gaps)) if len(gaps) else np.inf


def _reading(samples: Samples, knot: Knot) -> tuple[float, float] | None:
    """Mean speed and mean acceleration within a knot; a whole period of a periodic motion has no acceleration."""
    begin, end = (int(i) for i in np.searchsorted(samples.time_s, (knot.start_s - 1e-9, knot.end_s - 1e-9)))
    if end - begin < 2:
        return None
    time, width, _ = _cells(samples.time_s, slice(begin, end))
    speed, whole = samples.speed_rad_s[begin:end], float(np.sum(width))
    if not whole > 0.0:
        return None
    mean = float(width @ speed) / whole
    if knot.periodic:
        return mean, 0.0
    lever = time - float(width @ time) / whole
    spread = float(width @ lever**2)
    return (mean, float(width @ (lever * speed)) / spread) if spread > 0.0 else None


def overlap_s(earlier: Row, later: Row) -> float:
    """∫w_i w_{i+1} of two neighbouring rows, s."""
    return earlier.second.length_s / 6.0 if earlier.second == later.first else 0.0


def through(samples: Samples, start_s: float, end_s: float, knot_s: float, *, periodic: bool = False) -> Row | None:
    """The balance over one stretch, from a knot at its start to one at its end; None where samples are missing."""
    return balance(samples, Knot(start_s, start_s + knot_s, periodic), Knot(end_s - knot_s, end_s, periodic))
