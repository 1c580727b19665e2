r"""Why the paper's estimate is low: the start from rest, in closed form.

The fit of T_in on α gives, with T_in = Jα + Bω + T_f,

    Ĵ − J = B cov(ω, α)/var(α) + cov(T_f, α)/var(α) + a term from sampling.

**Viscous.** Over a record 0…T that begins at rest and ends near the offset E, mean(ωα) = ω(T)²/2T and
mean ω · mean α ≈ E·E/T, so cov(ω, α) ≈ −E²/(2T): while the speed is still low, the acceleration is large.

**Sampling.** α between two samples belongs to the middle of the interval, T_in to its end: T_in is late by Ts/2,
which adds (Ts/2)·J·mean(α dα/dt) = (Ts/2)·J·(α(T)² − α(0)²)/(2T) ≈ −J Ts (Kp E/J)²/(4T), as the first torque is Kp·E.

**var(α)** is that of the sine, (2πf A|G|)²/2, and of the start-up, (1/T)∫α_tr² dt, with
G = (Kp s + Ki)/(J s² + (Kp + B)s + Ki) at s = j2πf. A step to E makes
α_tr = E(Kp s + Ki)/(J s² + (Kp + B)s + Ki), and by Parseval (the integral of a second order,
(b1² a0 + b0² a2)/(2 a0 a1 a2)) ∫α_tr² dt = E²(Kp² + Ki J)/(2J(Kp + B)).

Left out: the bristle, which fills while the shaft starts (a few tenths to 4 kg·m², lower still), and reversals. What
remains in steady state is B·Ts/2 (see `processing.torque_line`): whole periods make cov(ω, α) zero.
"""

from __future__ import annotations

from math import pi

from tdhil.study.settings import LoopSettings


def closed_form_inertia(run: LoopSettings) -> float | None:
    """What the fit over all samples gives, about; None for references other than a sine."""
    if run.signal != "sine":
        return None
    inertia, viscous, offset, duration = run.inertia_kg_m2, run.viscous_nm_s_rad, run.offset_rad_s, run.duration_s
    kp, ki = run.kp_nm_s_rad, run.ki_nm_rad
    if kp + viscous == 0.0:
        return None
    s = 2j * pi * run.frequency_hz
    followed = abs((kp * s + ki) / (inertia * s * s + (kp + viscous) * s + ki))
    sine = 0.5 * abs(s * run.amplitude_rad_s * followed) ** 2
    start = offset**2 * (kp**2 + ki * inertia) / (2.0 * inertia * (kp + viscous)) / duration
    speed = viscous * offset**2 / (2.0 * duration)
    sampling = inertia * run.sample_period_s * (kp * offset / inertia) ** 2 / (4.0 * duration)
    return inertia - (speed + sampling) / (sine + start)
