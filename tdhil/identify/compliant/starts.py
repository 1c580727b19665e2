"""Where the descents of a compliant shaft begin: linear least squares over a grid of resonances.

Given how the load swings, what hangs below the motor is J_L H(s) with a known H, and behind first-order lags and a skew
d the equation of a line, Z = J_r s + B + J_L H, is linear: with T' = T e^(ds),

    T' = (J_r τ_w) s² W + (J_r + B τ_w) s W + B W + (J_L τ_w) s H W + J_L H W − τ_T s T',

six real unknowns. τ_w is then the ratio of the quadratic terms to the linear ones. The swing lies on a grid over the
band and around it, with little damping and with much; the string's share of the load on another.

No line may count for more than the grid's coarseness allows: with errors as small as they are, a resonance off by some
per cent is as wrong as none. So the lines are first taken for less exact than they are; the best of the grid are
brought down there, where the valleys are wide, and the best of those is where the real descents begin.
"""

from dataclasses import replace

import numpy as np

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.likelihood import Likelihood
from tdhil.estimation.frequency_domain.shafts import INERTIA, VISCOUS
from tdhil.estimation.frequency_domain.spectrum import ComplexArray
from tdhil.identify.compliant.string_shaft import STRING_SHARE
from tdhil.identify.compliant.two_mass import DAMPING, LOAD, SWING
from tdhil.identify.lines.fit import Held, box, minimise, rough_inertia_of
from tdhil.recording.recording import FloatArray

_PER_OCTAVE = 24
_BEYOND = (0.6, 2.0)                     # the grid's ends, of the lowest and highest line
_RATIOS = (0.01, 0.1)                    # damping, of critical
_SHARES = (0.08, 0.15, 0.22, 0.3, 0.38, 0.46, 0.55, 0.65, 0.8, 1.0)
_SKEWS = (-0.05, 0.0, 0.05)
_BLUR = 0.08                             # relative error that every line is given
_ALIKE = (0.15, 0.12)                    # octaves of swing, share of the string
_TRIED, _KEPT = 24, 5


def compliant_starts(problem: Likelihood, held: Held) -> list[FloatArray]:
    """The most promising theta, (P,) each; for `TwoMassShaft` and `StringShaft`."""
    lines = tuple(
        replace(line, s_tt=line.s_tt + _BLUR**2 * float(np.mean(np.abs(line.torque) ** 2 * line.periods)))
        for line in problem.lines
    )
    blurred = Likelihood(lines, problem.model, problem.tie, problem.priors)
    limits = box(problem, rough_inertia_of(problem))
    first_order = {**dict.fromkeys(problem.model.structure, 0.0), **held}
    fits = [minimise(blurred, limits, start, first_order) for start in _proposals(blurred)]
    return [fit.theta for fit in sorted(fits, key=lambda fit: fit.objective)[:_KEPT]]


def _proposals(problem: Likelihood) -> list[FloatArray]:
    """Of every neighbourhood of the grid the best, in rising misfit."""
    shapes = _shapes(problem)
    hung = np.array([problem.model.shaft.impedance(shape, problem.s) for shape in shapes])[:, problem.owner]
    solved = [_solved(problem, hung, skew) for skew in _SKEWS]
    misfits = np.array([misfit for misfit, _ in solved])           # (skews, shapes)
    found: list[FloatArray] = []
    kept: list[FloatArray] = []
    for flat in np.argsort(misfits, axis=None, kind="stable"):
        skew_at, at = (int(i) for i in np.unravel_index(flat, misfits.shape))
        if not np.isfinite(misfits[skew_at, at]) or any(_alike(shapes[at], other) for other in kept):
            continue
        theta = _theta(problem, shapes[at], solved[skew_at][1][at], _SKEWS[skew_at])
        if theta is not None:
            found.append(theta)
            kept.append(shapes[at])
        if len(found) == _TRIED:
            break
    return found


def _shapes(problem: Likelihood) -> list[FloatArray]:
    """Mechanical parameters of nothing but a load of 1 kg·m², swinging in every way of the grid."""
    omega = np.abs(problem.s)
    low, high = _BEYOND[0] * float(np.min(omega)), _BEYOND[1] * float(np.max(omega))
    swings = np.geomspace(low, high, max(2, round(_PER_OCTAVE * np.log2(high / low))))
    size = problem.model.mechanical
    shapes = []
    for share in _SHARES if size > STRING_SHARE else (0.0,):
        for ratio in _RATIOS:
            for swing in swings:
                shape = np.zeros(size)
                shape[LOAD], shape[SWING], shape[DAMPING] = 1.0, swing, 2.0 * ratio * swing
                shape[STRING_SHARE:] = share
                shapes.append(shape)
    return shapes


def _alike(one: FloatArray, other: FloatArray) -> bool:
    near = abs(np.log2(one[SWING] / other[SWING])) < _ALIKE[0]
    return bool(near and np.all(np.abs(one[STRING_SHARE:] - other[STRING_SHARE:]) < _ALIKE[1]))


def _solved(problem: Likelihood, hung: ComplexArray, skew: float) -> tuple[FloatArray, FloatArray]:
    """Misfit (H,) and unknowns (H, 6) for every shape; ``hung`` (H, N): its H(s) at every observation."""
    w, s = problem.speed, problem.s[problem.owner]
    lines = len(problem.s)
    ratio = problem.torque / w
    mean = (np.bincount(problem.owner, ratio.real, lines) + 1j * np.bincount(problem.owner, ratio.imag, lines))
    weight = problem.root_periods / np.sqrt(problem.variance(mean / problem.segments))[problem.owner]
    torque = problem.torque * np.exp(skew * s)
    plain = np.broadcast_to(np.stack([s * s * w, s * w, w, -s * torque], axis=1), (len(hung), len(w), 4))
    columns = np.concatenate([plain, (hung * s * w)[:, :, None], (hung * w)[:, :, None]], axis=2) * weight[:, None]
    design = np.concatenate([columns.real, columns.imag], axis=1)
    target = np.concatenate([(torque * weight).real, (torque * weight).imag])
    scale = np.maximum(np.linalg.norm(design, axis=1), 1e-300)     # (H, 6)
    design = design / scale[:, None, :]
    normal = np.swapaxes(design, 1, 2) @ design + 1e-10 * np.eye(design.shape[2])
    x = np.linalg.solve(normal, (np.swapaxes(design, 1, 2) @ target)[:, :, None])[:, :, 0]
    left = target - (design @ x[:, :, None])[:, :, 0]
    return np.sum(left**2, axis=1), x / scale


def _theta(problem: Likelihood, shape: FloatArray, x: FloatArray, skew: float) -> FloatArray | None:
    """The unknowns as parameters; None where an inertia comes out negative."""
    quadratic, linear, viscous, torque_lag, load_late, load = (float(value) for value in x)
    size = linear**2 + load**2
    speed_lag = (quadratic * linear + load_late * load) / size if size > 0.0 else 0.0
    speed_lag = float(np.clip(speed_lag, 0.0, signal_filters.LAG_BOUND_S))
    inertia = linear - viscous * speed_lag
    if inertia <= 0.0 or load <= 0.0:
        return None
    mechanical = shape.copy()
    mechanical[INERTIA], mechanical[VISCOUS], mechanical[LOAD] = inertia, viscous, load
    mechanical[DAMPING] *= load
    phi = np.zeros(signal_filters.COUNT)
    phi[signal_filters.SPEED_LAG] = speed_lag
    phi[signal_filters.TORQUE_LAG] = float(np.clip(torque_lag, 0.0, signal_filters.LAG_BOUND_S))
    phi[signal_filters.SKEW] = skew
    theta = np.concatenate([mechanical, phi])
    for prior in problem.priors:
        theta[prior.index] = prior.mean
    return theta
