"""Likelihood of parameters given the lines: errors in both signals, and weights that are estimates.

For line k with segment means W̄_s, T̄_s over P_s periods and the one-period covariance S on ν complex degrees of
freedom, the equation error r_s = T̄_s − G W̄_s has the variance v/P_s, v = S_TT + |G|² S_WW − 2 Re(G* S_TW). With the
true lines and the true covariance concentrated out of the Gaussian likelihood (det(νS + rank one) = det(νS)(1 + q/ν)),

    −2 ln L = Σ_k 2 (ν_k + M_k) ln(1 + q_k/ν_k) + priors,    q_k = Σ_s P_s |r_s|² / v_k,

with M segments. This is a complex t-distribution: its tails contain the uncertainty of the weights, and for ν → ∞ it is
Σ 2q, a χ². For least squares it is a sum of squares of φ(q)·r/√v with φ² = 2(ν + M) ln(1 + q/ν)/q, smooth at q = 0. A
torque that is not proportional to the speed at the line, c N_s of nonlinear friction (`TorqueLoad`), is first
subtracted from T̄_s. The constraint of B by the levels is a real t-distribution, (n + 1) ln(1 + z²/n). Priors on the
lags are Gaussian.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.shafts import Believing
from tdhil.estimation.friction_levels import ViscousConstraint
from tdhil.estimation.spectrum import ComplexArray, SpectralLine
from tdhil.recording import FloatArray

_SERIES = 1e-4          # q/ν below which a series is used

LEAST_NU = 2.0
"""Least complex degrees of freedom ν of a line's weight. With fewer, the tails of the likelihood give no interval."""


@dataclass(frozen=True)
class TorqueLoad:
    """Torque proportional to theta[index]: N·m per unit of it, in every segment mean of every line, in their order."""

    index: int
    lines: ComplexArray


class Likelihood:
    """−2 ln L of a model's theta (P,), as a sum of squares."""

    def __init__(
        self,
        lines: tuple[SpectralLine, ...],
        model: Model,
        constraint: ViscousConstraint | None,
        priors: tuple[GaussianPrior, ...],
        load: TorqueLoad | None = None,
    ) -> None:
        self.lines, self.model, self.constraint, self.priors = lines, model, constraint, priors
        self.s: ComplexArray = 2j * np.pi * np.array([line.hertz for line in lines])
        self.owner: NDArray[np.intp] = np.repeat(np.arange(len(lines)), [len(line.speed) for line in lines])
        self.speed: ComplexArray = np.concatenate([line.speed for line in lines])
        self.torque: ComplexArray = np.concatenate([line.torque for line in lines])
        self.root_periods: FloatArray = np.sqrt(np.concatenate([line.periods for line in lines]))
        self.s_ww = np.array([line.s_ww for line in lines])
        self.s_tt = np.array([line.s_tt for line in lines])
        self.s_tw = np.array([line.s_tw for line in lines])
        self.nu = np.array([line.nu for line in lines])
        self.segments = np.array([float(len(line.speed)) for line in lines])
        self._s_wt: ComplexArray = self.s_tw.conj()
        self._scale = 2.0 * (self.nu + self.segments) / self.nu
        self._half_scale = 0.5 * self._scale / self.nu
        self._load = load
        self._believing = model.shaft if isinstance(model.shaft, Believing) else None
        self._of_line = np.equal.outer(np.arange(len(lines)), self.owner).astype(np.float64)
        self._twice_tw = 2.0 * self.s_tw
        known = (*priors, *model.plausible({prior.index for prior in priors}))
        self._prior_rows = np.zeros((len(known), model.size))
        for row, prior in enumerate(known):
            self._prior_rows[row, prior.index] = 1.0 / prior.sd
        self._prior_offset = np.array([prior.mean / prior.sd for prior in known])
        stated = {prior.index for prior in priors}
        lags = (model.at(signal_filters.SPEED_LAG), model.at(signal_filters.TORQUE_LAG))
        self._lags = lags if model.rigid and not stated & set(lags) else None
        self._unseen_s = signal_filters.unseen_lag(float(np.max(np.abs(self.s))))
        slope = 0.0 if constraint is None else constraint.slope_per_inertia
        self._tie_row = model.viscous_row + slope * model.inertia_row

    @property
    def numbers(self) -> int:
        """Return n, the number of fitted real numbers."""
        beliefs = len(self.beliefs(np.ones(self.model.size))[0])
        return 2 * len(self.owner) + len(self.priors) + (self.constraint is not None) + beliefs

    @property
    def held(self) -> int:
        """Return the number of parameters held by prior knowledge rather than by the lines."""
        return 0 if self._believing is None else self._believing.held

    def beliefs(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the deviation of theta from the prior knowledge of the shaft, in sd, (R,), and the slopes, (R, P)."""
        if self._believing is None:
            return np.zeros(0), np.zeros((0, self.model.size))
        off, slopes = self._believing.beliefs(theta[: self.model.mechanical])
        wide = np.zeros((len(slopes), self.model.size))
        wide[:, : self.model.mechanical] = slopes
        return off, wide

    def unloaded(self, theta: FloatArray) -> tuple[SpectralLine, ...]:
        """Return the lines without the torque of the load."""
        if self._load is None:
            return self.lines
        torque = self._unloaded(theta)
        return tuple(replace(line, torque=torque[self.owner == k]) for k, line in enumerate(self.lines))

    def _unloaded(self, theta: FloatArray) -> ComplexArray:
        return self.torque if self._load is None else self.torque - theta[self._load.index] * self._load.lines

    def variance(self, g: ComplexArray) -> FloatArray:
        """Return v_k of one period's equation error, (K,), with a floor where only rounding remains."""
        alone = self.s_tt + (g.real * g.real + g.imag * g.imag) * self.s_ww
        v: FloatArray = np.maximum(alone - (g.real * self._twice_tw.real + g.imag * self._twice_tw.imag), 1e-9 * alone)
        return v

    def weighted(self, theta: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """Return √P r/√v of every segment and line, and q (K,)."""
        g = self.model.impedance(theta, self.s)
        return self._weighted(theta, g, self._gain(self.variance(g)))

    def _gain(self, v: FloatArray) -> FloatArray:
        """Return √P/√v of every segment and line."""
        gain: FloatArray = self.root_periods / np.sqrt(v)[self.owner]
        return gain

    def _weighted(self, theta: FloatArray, g: ComplexArray, gain: FloatArray) -> tuple[ComplexArray, FloatArray]:
        torque = self.torque if self._load is None else self._unloaded(theta)
        e: ComplexArray = (torque - g[self.owner] * self.speed) * gain
        q: FloatArray = self._of_line.dot(e.real * e.real + e.imag * e.imag)
        return e, q

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Return a real vector whose sum of squares is −2 ln L."""
        return self.at(theta)[0]

    def linearised(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residuals (R,) and ∂residuals/∂theta (R, P)."""
        residuals, slopes = self.at(theta)
        return residuals, slopes()

    def at(self, theta: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]]:
        """Return the residuals (R,), and a function that gives ∂residuals/∂theta (R, P) on demand.

        With u = √P r/√v: ∂u = −√P ∂(G W + c N)/√v − u Re(h ∂G), h = (G* S_WW − S_TW*)/v, since ∂v = 2 v Re(h ∂G); ∂q =
        2 Σ Re(u* ∂u), and ∂(φ u) = φ ∂u + φ' ∂q u. Except W, N and u, all factors are one number for a line. They are
        summed before the product with ∂G:

            ∂(φ u) = −φ √P ∂(G W + c N)/√v − u Re[(φ h + 2 φ' (q h + Σ u* √P W/√v)) ∂G] − 2 φ' u Re Σ u* √P N ∂c/√v.

        The slopes are on demand, because a descent does not need them at every point that it tries.
        """
        g, g_slopes = self.model.seen(theta, self.s)
        v = self.variance(g)
        gain = self._gain(v)
        u, q = self._weighted(theta, g, gain)
        phi, phi_slope = self._phi(q)
        k, n, sized = self.owner, len(self.owner), phi[self.owner]
        pulled = sized * u
        known, known_slopes = self._known(theta)
        residuals = np.concatenate((pulled.real, pulled.imag, known))

        def slopes() -> FloatArray:
            by_g, phi_twice = g_slopes(), 2.0 * phi_slope()
            by_v = (g.conj() * self.s_ww - self._s_wt) / v
            pull = u.conj() * gain
            own = pull * self.speed
            sums = np.empty(len(self.s), dtype=np.complex128)      # over the segments of every line
            sums.real, sums.imag = self._of_line.dot(own.real), self._of_line.dot(own.imag)
            turned = phi * by_v + phi_twice * (q * by_v + sums)
            each: ComplexArray = (gain * sized * self.speed) * by_g[:, k] + u * (turned * by_g).real[:, k]
            if self._load is not None:
                by_q = phi_twice * (self._of_line @ (pull * self._load.lines).real)
                each[self._load.index] += gain * sized * self._load.lines + u * by_q[k]
            found = np.empty((len(theta), len(residuals)))
            np.negative(each.real, out=found[:, :n])
            np.negative(each.imag, out=found[:, n : 2 * n])
            found[:, 2 * n :] = known_slopes()
            return found.T

        return residuals, slopes

    def _phi(self, q: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]]:
        """Return φ(q) = √(2 (ν + M) ln(1 + q/ν)/q), (K,), and a function for dφ/dq; by a series if q/ν is small."""
        x = q / self.nu
        small = x < _SERIES
        few = True in small.tolist()     # rarely the case
        safe = np.where(small, 1.0, x) if few else x
        plain = np.log1p(safe) / safe
        phi: FloatArray = np.sqrt(self._scale * (np.where(small, 1.0 - x / 2.0 + x * x / 3.0, plain) if few else plain))

        def slope() -> FloatArray:
            found = (1.0 / (1.0 + safe) - plain) / safe
            if few:
                found = np.where(small, -0.5 + 2.0 * x / 3.0, found)
            of_q: FloatArray = self._half_scale * found / phi
            return of_q

        return phi, slope

    def objective(self, theta: FloatArray) -> float:
        """Return −2 ln L."""
        return float(np.sum(self.residuals(theta) ** 2))

    def _known(self, theta: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]]:
        """Return the residuals of the prior knowledge besides the lines, and a function for their slopes (P, R).

        The order: priors, beliefs, the common lag of the reports, the constraint of B.
        """
        tie = self.constraint
        off = self._prior_rows.dot(theta) - self._prior_offset
        believed = None if self._believing is None else self.beliefs(theta)
        shared = None if self._lags is None else self._shared_lag(theta)
        z = 0.0 if tie is None else self.tie_error(theta)
        pull = 0.0 if tie is None else math.copysign(math.sqrt((tie.dof + 1.0) * math.log1p(z * z / tie.dof)), z)
        residuals = np.concatenate((
            off, () if believed is None else believed[0], () if shared is None else shared[:1],
            () if tie is None else (pull,),
        ))

        def slopes() -> FloatArray:
            found = np.zeros((len(theta), len(residuals)))
            found[:, : len(off)] = self._prior_rows.T
            at = len(off)
            if believed is not None:
                found[:, at : at + len(believed[0])] = believed[1].T
                at += len(believed[0])
            if shared is not None and self._lags is not None:
                found[self._lags[0], at], found[self._lags[1], at] = shared[1:]
                at += 1
            if tie is not None:
                n, value = tie.dof, abs(pull)
                slope = (n + 1.0) * abs(z) / (n + z * z) / value if value > 1e-6 else math.sqrt((n + 1.0) / n)
                found[:, at] = slope / tie.sd * self._tie_row
            return found

        return residuals, slopes

    def _shared_lag(self, theta: FloatArray) -> tuple[float, float, float]:
        """Return the penalty on the reports' common lag (`signal_filters.shared_lag`), and its slopes by either lag."""
        assert self._lags is not None
        speed, torque = self._lags
        return signal_filters.shared_lag(float(theta[speed]), float(theta[torque]), self._unseen_s)

    def tie_error(self, theta: FloatArray) -> float:
        """Return the deviation of the friction from that of the levels, in standard deviations.

        The levels determine a combination of theta: the friction slope plus its slope per inertia times J.
        """
        assert self.constraint is not None
        return (float(self._tie_row.dot(theta)) - self.constraint.slope) / self.constraint.sd

    def information(self, theta: FloatArray) -> tuple[FloatArray, list[tuple[FloatArray, float]]]:
        """Return the Fisher information (P, P), and its parts with the degrees of freedom of each part's weight.

        A line has 2 Re Σ P ∂(G W̄)ᴴ∂(G W̄) / v · (ν − 1)/ν, since E 1/v̂ = ν/((ν − 1) v). The constraint and the priors
        have 1/sd².
        """
        g, slopes = self.model.impedance_jacobian(theta, self.s)
        by: ComplexArray = self.speed[:, None] * slopes[self.owner]      # ∂(G W̄ + c N)/∂theta of every segment and line
        if self._load is not None:
            by[:, self._load.index] += self._load.lines
        by = by * self.root_periods[:, None]
        weight = 2.0 / self.variance(g)
        parts: list[tuple[FloatArray, float]] = []
        for k in range(len(self.s)):
            shrink = max(self.nu[k] - 1.0, 0.5) / self.nu[k]
            own = by[self.owner == k]
            part: FloatArray = weight[k] * shrink * (own.conj().T @ own).real
            parts.append((part, 2.0 * float(self.nu[k])))
        parts += [(np.outer(row, row), np.inf) for row in self._prior_rows]
        parts += [(np.outer(row, row), np.inf) for row in self.beliefs(theta)[1]]
        if self._lags is not None:
            row = np.zeros(self.model.size)
            _, *row[list(self._lags)] = self._shared_lag(theta)
            parts.append((np.outer(row, row), np.inf))
        if self.constraint is not None:
            parts.append((np.outer(self._tie_row, self._tie_row) / self.constraint.sd**2, self.constraint.dof))
        return np.sum([part for part, _ in parts], axis=0), parts
