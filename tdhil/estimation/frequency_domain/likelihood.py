"""How well a set of parameters explains the lines: errors in both signals, weights known only by estimate.

For line k with segment means W̄_s, T̄_s over P_s periods and the one-period covariance S on ν complex degrees of
freedom, the equation error r_s = T̄_s − G W̄_s has the variance v/P_s, v = S_TT + |G|² S_WW − 2 Re(G* S_TW). With the
true lines and the true covariance concentrated out of the Gaussian likelihood
(det(νS + rank one) = det(νS)(1 + q/ν)),

    −2 ln L = Σ_k 2 (ν_k + M_k) ln(1 + q_k/ν_k) + priors,    q_k = Σ_s P_s |r_s|² / v_k,

M segments. This is a complex t-distribution: what the weights don't know is in its tails, and for ν → ∞ it is Σ 2q,
a χ². It is a sum of squares of φ(q)·r/√v with φ² = 2(ν + M) ln(1 + q/ν)/q, smooth at q = 0, for least squares.
What acts on the shaft besides and doesn't go with the speed at the line, c N_s of a bent friction (`Load`), is taken
off T̄_s first. The tie of B to the levels is a real t-distribution, (n + 1) ln(1 + z²/n); what is known of the lags is
Gaussian.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tdhil.estimation.frequency_domain import signal_filters
from tdhil.estimation.frequency_domain.friction_levels import ViscousConstraint
from tdhil.estimation.frequency_domain.model import GaussianPrior, Model
from tdhil.estimation.frequency_domain.shafts import Believing
from tdhil.estimation.frequency_domain.spectrum import ComplexArray, Line
from tdhil.recording import FloatArray


@dataclass(frozen=True)
class Load:
    """Torque in proportion to theta[index]: N·m per its unit in every segment mean of every line, in their order."""

    index: int
    lines: ComplexArray


class Likelihood:
    """−2 ln L of a model's theta (P,), a sum of squares."""

    def __init__(
        self,
        lines: tuple[Line, ...],
        model: Model,
        constraint: ViscousConstraint | None,
        priors: tuple[GaussianPrior, ...],
        load: Load | None = None,
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
        self._scale = 2.0 * (self.nu + self.segments) / self.nu
        self._load = load
        self._believing = model.shaft if isinstance(model.shaft, Believing) else None
        self._of_line = np.equal.outer(np.arange(len(lines)), self.owner).astype(np.float64)
        known = (*priors, *model.plausible({prior.index for prior in priors}))
        self._prior_rows = np.zeros((len(known), model.size))
        for row, prior in enumerate(known):
            self._prior_rows[row, prior.index] = 1.0 / prior.sd
        self._prior_index = np.array([prior.index for prior in known], dtype=np.intp)
        self._prior_mean = np.array([prior.mean for prior in known])
        self._prior_sd = np.array([prior.sd for prior in known])
        stated = {prior.index for prior in priors}
        lags = (model.at(signal_filters.SPEED_LAG), model.at(signal_filters.TORQUE_LAG))
        self._lags = lags if model.rigid and not stated & set(lags) else None
        self._unseen_s = signal_filters.unseen_lag(float(np.max(np.abs(self.s))))
        slope = 0.0 if constraint is None else constraint.slope_per_inertia
        self._tie_row = model.viscous_row + slope * model.inertia_row

    @property
    def numbers(self) -> int:
        """n: how many real numbers are fitted."""
        beliefs = len(self.beliefs(np.ones(self.model.size))[0])
        return 2 * len(self.owner) + len(self.priors) + (self.constraint is not None) + beliefs

    def beliefs(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far theta is from what is known of the shaft beforehand, in sd, (R,), and the slopes, (R, P)."""
        if self._believing is None:
            return np.zeros(0), np.zeros((0, self.model.size))
        off, slopes = self._believing.beliefs(theta[: self.model.mechanical])
        return off, np.pad(slopes, ((0, 0), (0, self.model.size - slopes.shape[1])))

    def unloaded(self, theta: FloatArray) -> tuple[Line, ...]:
        """The lines without the torque of the load."""
        if self._load is None:
            return self.lines
        torque = self._unloaded(theta)
        return tuple(replace(line, torque=torque[self.owner == k]) for k, line in enumerate(self.lines))

    def _unloaded(self, theta: FloatArray) -> ComplexArray:
        return self.torque if self._load is None else self.torque - theta[self._load.index] * self._load.lines

    def variance(self, g: ComplexArray) -> FloatArray:
        """v_k of one period's equation error, (K,); floored where the cross term cancels all but rounding."""
        alone = self.s_tt + np.abs(g) ** 2 * self.s_ww
        v: FloatArray = np.maximum(alone - 2.0 * (g.conj() * self.s_tw).real, 1e-9 * alone)
        return v

    def weighted(self, theta: FloatArray) -> tuple[ComplexArray, FloatArray]:
        """√P r/√v of every segment and line, and q (K,)."""
        g = self.model.impedance(theta, self.s)
        root_v = np.sqrt(self.variance(g))
        e: ComplexArray = self._error(theta, g) * self.root_periods / root_v[self.owner]
        q: FloatArray = self._of_line @ (e.real**2 + e.imag**2)
        return e, q

    def _error(self, theta: FloatArray, g: ComplexArray) -> ComplexArray:
        """The equation error of every segment and line."""
        error: ComplexArray = self._unloaded(theta) - g[self.owner] * self.speed
        return error

    def residuals(self, theta: FloatArray) -> FloatArray:
        """A real vector whose sum of squares is −2 ln L."""
        e, q = self.weighted(theta)
        u = self._phi(q, False)[0][self.owner] * e
        return np.concatenate([u.real, u.imag, self._prior_residuals(theta)])

    def linearised(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The residuals (R,) and ∂residuals/∂theta (R, P).

        With u = √P r/√v: ∂u = −√P W ∂G/√v − u ∂v/(2v), ∂v = 2 Re(G* ∂G) S_WW − 2 Re(∂G* S_TW), ∂q = 2 Σ Re(u* ∂u),
        and ∂(φ u) = φ ∂u + φ' ∂q u.
        """
        g, slopes = self.model.impedance_jacobian(theta, self.s)
        v = self.variance(g)
        v_slopes = 2.0 * (
            (g.conj()[:, None] * slopes).real * self.s_ww[:, None] - (slopes.conj() * self.s_tw[:, None]).real
        )
        k = self.owner
        gain = self.root_periods / np.sqrt(v)[k]
        e: ComplexArray = self._error(theta, g) * gain
        q = self._of_line @ (e.real**2 + e.imag**2)
        e_slopes = -gain[:, None] * self._by(slopes) - e[:, None] * (v_slopes / (2.0 * v[:, None]))[k]
        q_slopes = 2.0 * (self._of_line @ (e.conj()[:, None] * e_slopes).real)
        phi, phi_slope = self._phi(q)
        u = phi[k] * e
        u_slopes = phi[k][:, None] * e_slopes + e[:, None] * (phi_slope[:, None] * q_slopes)[k]
        return (
            np.concatenate([u.real, u.imag, self._prior_residuals(theta)]),
            np.concatenate([u_slopes.real, u_slopes.imag, self._prior_jacobian(theta)]),
        )

    def _by(self, slopes: ComplexArray) -> ComplexArray:
        """∂(G W̄ + c N)/∂theta of every segment and line, from ∂G/∂theta (K, P)."""
        found: ComplexArray = self.speed[:, None] * slopes[self.owner]
        if self._load is not None:
            found[:, self._load.index] += self._load.lines
        return found

    def _phi(self, q: FloatArray, sloped: bool = True) -> tuple[FloatArray, FloatArray]:
        """φ(q) = √(2 (ν + M) ln(1 + q/ν)/q) and dφ/dq, (K,) each; by series where q/ν is small.

        This is called thousands of times for one interval. Not ``sloped``: the second is left out.
        """
        x = q / self.nu
        if x.min() >= 1e-4:          # as nearly always
            ratio = np.log1p(x) / x
            slope = (1.0 / (1.0 + x) - ratio) / x if sloped else ratio
        else:
            small = x < 1e-4
            safe = np.where(small, 1.0, x)
            plain = np.log1p(safe) / safe
            ratio = np.where(small, 1.0 - x / 2.0 + x * x / 3.0, plain)
            slope = np.where(small, -0.5 + 2.0 * x / 3.0, (1.0 / (1.0 + safe) - plain) / safe)
        phi = np.sqrt(self._scale * ratio)
        return phi, self._scale * slope / (2.0 * phi * self.nu) if sloped else phi

    def objective(self, theta: FloatArray) -> float:
        """−2 ln L."""
        return float(np.sum(self.residuals(theta) ** 2))

    def _prior_residuals(self, theta: FloatArray) -> FloatArray:
        known: FloatArray = (theta[self._prior_index] - self._prior_mean) / self._prior_sd
        if self._believing is not None:
            known = np.concatenate([known, self.beliefs(theta)[0]])
        if self._lags is not None:
            known = np.append(known, self._shared_lag(theta)[0])
        if self.constraint is None:
            return known
        z = self.tie_error(theta)
        dof = self.constraint.dof
        found = np.empty(len(known) + 1)
        found[:-1], found[-1] = known, math.copysign(math.sqrt((dof + 1.0) * float(np.log1p(z * z / dof))), z)
        return found

    def _shared_lag(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """What the reports' common lag costs (`signal_filters.shared_lag`), and its slopes (P,)."""
        assert self._lags is not None
        row = np.zeros(self.model.size)
        speed, torque = self._lags
        value, row[speed], row[torque] = signal_filters.shared_lag(
            float(theta[speed]), float(theta[torque]), self._unseen_s
        )
        return value, row

    def _prior_jacobian(self, theta: FloatArray) -> FloatArray:
        rows = self._prior_rows
        if self._believing is not None:
            rows = np.concatenate([rows, self.beliefs(theta)[1]])
        if self._lags is not None:
            rows = np.concatenate([rows, self._shared_lag(theta)[1][None, :]])
        if self.constraint is None:
            return rows
        z, n = self.tie_error(theta), self.constraint.dof
        value = np.sqrt((n + 1.0) * np.log1p(z * z / n))
        slope = (n + 1.0) * abs(z) / (n + z * z) / value if value > 1e-6 else np.sqrt((n + 1.0) / n)
        return np.concatenate([rows, slope / self.constraint.sd * self._tie_row[None, :]])

    def tie_error(self, theta: FloatArray) -> float:
        """How far the friction is from what the levels say, in standard deviations.

        The combination of theta that they speak of is the friction slope plus its slope per inertia.
        """
        assert self.constraint is not None
        return float((self._tie_row @ theta - self.constraint.slope) / self.constraint.sd)

    def information(self, theta: FloatArray) -> tuple[FloatArray, list[tuple[FloatArray, float]]]:
        """Fisher information (P, P), and its parts with the degrees of freedom of each part's weight.

        Of a line: 2 Re Σ P ∂(G W̄)ᴴ∂(G W̄) / v · (ν − 1)/ν, since E 1/v̂ = ν/((ν − 1) v). Of the tie and priors: 1/sd².
        """
        g, slopes = self.model.impedance_jacobian(theta, self.s)
        by = self._by(slopes) * self.root_periods[:, None]
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
            row = self._shared_lag(theta)[1]
            parts.append((np.outer(row, row), np.inf))
        if self.constraint is not None:
            parts.append((np.outer(self._tie_row, self._tie_row) / self.constraint.sd**2, self.constraint.dof))
        return np.sum([part for part, _ in parts], axis=0), parts
