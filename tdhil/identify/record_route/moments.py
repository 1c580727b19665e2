r"""Is the scatter the same at all times? Errors of time stamps, rounding and friction come with the motion.

The fit's score is a sum over test functions; cut by smooth blocks u_b that add up to one, φ = Σ_b u_b φ, it is a sum
over stretches of time too,

    g_b = Σ_m 2 Re(∂e_m* e_mb)/v_m,      Σ_b g_b = 0 at the best fit,

and Σ g_b g_bᵀ with its neighbours (weight ½) estimates the score's covariance whatever the noise does over time and
across frequencies: H⁻¹ (Σ …) H⁻¹ is the covariance of theta that needs no noise model ("sandwich").
"""

from dataclasses import dataclass

import numpy as np

from tdhil.estimation.samples import Samples
from tdhil.estimation.time_domain.equation import evaluate
from tdhil.estimation.time_domain.fit import Problem
from tdhil.estimation.time_domain.windows import Window, seen_through
from tdhil.identify.record_route.tapers import flat_top, times
from tdhil.recording.recording import FloatArray

_BLOCK_S = 4.0
_BLOCKS = 40
_LEAST_BLOCKS = 10
_WHITE = 0.89         # γ₀ + γ₁ of overlapping blocks over the whole variance γ₀ + 2γ₁, for white noise


@dataclass(frozen=True)
class Blocks:
    """Of one direction in parameter space: the sandwich's variance, and how many blocks it rests on."""

    variance: float
    count: float


def block_scores(problem: Problem, placed: tuple[Window, ...], theta: FloatArray) -> FloatArray:
    """g_b (blocks, 10), in the order of time."""
    total = sum(window.hop_s for window in placed)
    length = max(total / _BLOCKS, min(_BLOCK_S, total / _LEAST_BLOCKS))
    whole = evaluate(theta, problem.bins)
    weight = np.where(problem.bins.hertz > 0.0, 2.0, 1.0) / problem.variance
    scores = []
    for window in placed:
        mine = problem.bins.window == float(window.number)
        if not np.any(mine):
            continue
        own = problem.bins.chosen(mine)
        pull = whole.slopes[mine].conj() * weight[mine, None]
        for part, shape in _blocks(window, length):
            error = evaluate(theta, seen_through(window, part, shape, own.s)).error
            scores.append((pull * error[:, None]).real.sum(axis=0))
    return np.array(scores).reshape(-1, len(theta))


def sandwich(scores: FloatArray, direction: FloatArray) -> Blocks:
    """Of directionᵀ·theta, where ``direction`` = H⁻¹ e (10,)."""
    each = scores @ direction
    if len(each) < 3:
        return Blocks(0.0, 1.0)
    square = float(each @ each)
    neighbours = float(each[1:] @ each[:-1])
    count = square**2 / max(float(np.sum(each**4)), 1e-300)
    # each block's share has lost what the fit took from it: about one part in their effective number
    return Blocks(max(square + neighbours, 0.5 * square) / _WHITE * count / max(count - 1.0, 1.0), count)


def _blocks(window: Window, length: float) -> list[tuple[Samples, FloatArray]]:
    """The window cut by blocks, half of each shared with either neighbour."""
    count = max(1, round(window.length_s / length))
    hop = window.length_s / count
    found = []
    for number in range(count + 1):
        begin, end = (number - 1) * hop, (number + 1) * hop
        part = window.part(begin, end)
        if len(part) < 3:
            continue
        time = part.time_s - window.start_s
        found.append((part, times(flat_top(time - begin, 2.0 * hop, hop), window.shape(time))))
    return found
