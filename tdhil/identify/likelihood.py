"""How well a set of parameters explains the lines: errors in both signals, weights known only by estimate.

For line k with segment means W̄_s, T̄_s over P_s periods and the one-period covariance S on ν complex degrees of
freedom, the equation error r_s = T̄_s − G W̄_s has the variance v/P_s, v = S_TT + |G|² S_WW − 2 Re(G* S_TW). With the
true lines and the true covariance concentrated out of the Gaussian likelihood
(det(νS + rank one) = det(νS)(1 + q/ν)),

    −2 ln L = Σ_k 2 (ν_k + M_k) ln(1 + q_k/ν_k) + priors,    q_k = Σ_s P_s |r_s|² / v_k,

M segments. This is a complex t-distribution: what the weights don't know is in its tails, and for ν → ∞ it is Σ 2q,
a χ². It is a sum of squares of φ(q)·r/√v with φ² = 2(ν + M) ln(1 + q/ν)/q, smooth at q = 0, for least squares.
The tie of B to the levels is a real t-distribution, (n + 1) ln(1 + z²/n); what is known of the lags is Gaussian.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdhil.identify.friction import ViscousTie
from tdhil.identify.rigid import INERTIA, VISCOUS, SpeedReport, impedance, impedance_jacobian
from tdhil.identify.spectrum import ComplexArray, Line
from tdhil.record.recording import FloatArray

LAG_BOUND_S = 2.0
SKEW_BOUND_S = 0.3


@dataclass(frozen=True)
class GaussianPrior:
    """A parameter (its index in theta) known beforehand."""

    index: int
    mean: float
    sd: float


class Likelihood:
    """−2 ln L of theta = (J, B, τ_w, τ_T, d) for one structure of the speed report."""

    def __init__(
        self, lines: tuple[Line, ...], report: SpeedReport, tie: ViscousTie | None, priors: tuple[GaussianPrior, ...]
    ) -> None:
        self.lines, self.report, self.tie, self.priors = lines, report, tie, priors
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

    def variance(self, g: ComplexArray) -> FloatArray:
        """v_k of one period's equation error, (K,); floored where the cross term cancels all but rounding."""
        v: FloatArray = self.s_tt + np.abs(g) ** 2 * self.s_ww - 2.0 * (g.conj() * self.s_tw).real
        floored: FloatArray = np.maximum(v, 1e-9 * (self.s_tt + np.abs(g) ** 2 * self.s_ww))
        return floored

    def weighted(self, theta: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """√P r/√v of every segment and line, and q (K,)."""
        g = impedance(theta, self.s, self.report)
        root_v = np.sqrt(self.variance(g))
        e: ComplexArray = (self.torque - g[self.owner] * self.speed) * self.root_periods / root_v[self.owner]
        q = np.bincount(self.owner, weights=e.real**2 + e.imag**2, minlength=len(self.lines))
        return e, q.astype(np.float64)

    def residuals(self, theta: FloatArray) -> FloatArray:
        """A real vector whose sum of squares is −2 ln L."""
        e, q = self.weighted(theta)
        u = self._phi(q)[0][self.owner] * e
        return np.concatenate([u.real, u.imag, self._prior_residuals(theta)])

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """∂residuals/∂theta, (R, 5).

        With u = √P r/√v: ∂u = −√P W ∂G/√v − u ∂v/(2v), ∂v = 2 Re(G* ∂G) S_WW − 2 Re(∂G* S_TW), ∂q = 2 Σ Re(u* ∂u),
        and ∂(φ u) = φ ∂u + φ' ∂q u.
        """
        g, slopes = impedance(theta, self.s, self.report), impedance_jacobian(theta, self.s, self.report)
        v = self.variance(g)
        v_slopes = 2.0 * (
            (g.conj()[:, None] * slopes).real * self.s_ww[:, None] - (slopes.conj() * self.s_tw[:, None]).real
        )
        e, q = self.weighted(theta)
        k = self.owner
        gain = (self.root_periods / np.sqrt(v)[k])[:, None]
        e_slopes = -gain * self.speed[:, None] * slopes[k] - e[:, None] * (v_slopes / (2.0 * v[:, None]))[k]
        q_slopes = np.zeros((len(self.lines), 5))
        np.add.at(q_slopes, k, 2.0 * (e.conj()[:, None] * e_slopes).real)
        phi, phi_slope = self._phi(q)
        u_slopes = phi[k][:, None] * e_slopes + e[:, None] * (phi_slope[:, None] * q_slopes)[k]
        return np.concatenate([u_slopes.real, u_slopes.imag, self._prior_jacobian(theta)])

    def _phi(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """φ(q) = √(2 (ν + M) ln(1 + q/ν)/q) and dφ/dq, (K,) each; by series where q/ν is small."""
        x = q / self.nu
        small = x < 1e-4
        safe = np.where(small, 1.0, x)
        ratio = np.where(small, 1.0 - x / 2.0 + x * x / 3.0, np.log1p(safe) / safe)
        slope = np.where(small, -0.5 + 2.0 * x / 3.0, (1.0 / (1.0 + safe) - np.log1p(safe) / safe) / safe)
        scale = 2.0 * (self.nu + self.segments) / self.nu
        phi = np.sqrt(scale * ratio)
        return phi, scale * slope / (2.0 * phi * self.nu)

    def objective(self, theta: FloatArray) -> float:
        """−2 ln L."""
        return float(np.sum(self.residuals(theta) ** 2))

    def _prior_residuals(self, theta: FloatArray) -> FloatArray:
        terms = [(theta[prior.index] - prior.mean) / prior.sd for prior in self.priors]
        if self.tie is not None:
            z = self.tie_error(theta)
            terms.append(np.sign(z) * np.sqrt((self.tie.dof + 1.0) * np.log1p(z * z / self.tie.dof)))
        return np.array(terms, dtype=np.float64)

    def _prior_jacobian(self, theta: FloatArray) -> FloatArray:
        rows = [np.eye(5)[prior.index] / prior.sd for prior in self.priors]
        if self.tie is not None:
            z, n = self.tie_error(theta), self.tie.dof
            value = np.sqrt((n + 1.0) * np.log1p(z * z / n))
            slope = (n + 1.0) * abs(z) / (n + z * z) / value if value > 1e-6 else np.sqrt((n + 1.0) / n)
            row = np.zeros(5)
            row[VISCOUS], row[INERTIA] = slope / self.tie.sd, slope * self.tie.slope_per_inertia / self.tie.sd
            rows.append(row)
        return np.array(rows, dtype=np.float64).reshape(-1, 5)

    def tie_error(self, theta: FloatArray) -> float:
        """How far B is from what the levels say, in standard deviations."""
        assert self.tie is not None
        expected = self.tie.slope - self.tie.slope_per_inertia * theta[INERTIA]
        return float((theta[VISCOUS] - expected) / self.tie.sd)

    def information(self, theta: FloatArray) -> tuple[FloatArray, list[tuple[FloatArray, float]]]:
        """Fisher information (5, 5), and its parts with the degrees of freedom of each part's weight.

        Of a line: 2 Re Σ P |W̄|² ∂Gᴴ∂G / v · (ν − 1)/ν, since E 1/v̂ = ν/((ν − 1) v). Of the tie and priors: 1/sd².
        """
        g = impedance(theta, self.s, self.report)
        slopes = impedance_jacobian(theta, self.s, self.report)
        energy = np.bincount(self.owner, weights=(np.abs(self.speed) * self.root_periods) ** 2, minlength=len(self.s))
        weight = 2.0 * energy / self.variance(g)
        parts: list[tuple[FloatArray, float]] = []
        for k in range(len(self.s)):
            shrink = max(self.nu[k] - 1.0, 0.5) / self.nu[k]
            part: FloatArray = weight[k] * shrink * np.outer(slopes[k].conj(), slopes[k]).real
            parts.append((part, 2.0 * float(self.nu[k])))
        for prior in self.priors:
            single = np.zeros((5, 5))
            single[prior.index, prior.index] = prior.sd**-2.0
            parts.append((single, np.inf))
        if self.tie is not None:
            direction = np.zeros(5)
            direction[VISCOUS], direction[INERTIA] = 1.0, self.tie.slope_per_inertia
            parts.append((np.outer(direction, direction) / self.tie.sd**2, self.tie.dof))
        return np.sum([part for part, _ in parts], axis=0), parts
