"""What can be set about one run of the paper's closed loop, and the names by which a factor or `--set` calls it.

The defaults are Table 1's where the paper names one value and inferred where it does not: friction and duration from
Table 6, P and I from the two gains of section 3.4.3 (see `figures_signal`). They are consistent with the published
figures, not confirmed by them.
"""

from __future__ import annotations

from math import pi
from typing import Annotated, Literal

from pydantic import Field, model_validator

from profiles.model import DataModel, Finding, refuse_if
from sim_bus.plant.batch import LARGEST_BRISTLE_STEP

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
SamplePeriod = Annotated[float, Field(gt=0.0, le=0.1)]

MAX_SAMPLES = 2_000_000
_MAX_GAIN = 0.5      # largest share of an error that P may remove in one sample: above it the samples aren't continuous
_SHORTER = "take a shorter sample_period_s"


class LoopSettings(DataModel):
    """One run: plant (equations 4 and 6), PI (equations 9, 10), reference (equation 8), record."""

    inertia_kg_m2: Positive = 900.0
    viscous_nm_s_rad: NonNegative = 74.3
    coulomb_nm: NonNegative = 82.4
    """Coulomb torque, the limit of Dahl's bristle (printed as N/m, is N·m)."""
    dahl_stiffness_nm_rad: Positive = 5000.0
    """Of Dahl's bristle (printed as N/m, is N·m/rad)."""
    friction: Literal["dahl", "coulomb"] = "dahl"
    kp_nm_s_rad: NonNegative = 15000.0
    ki_nm_rad: NonNegative = 9000.0
    frequency_hz: Positive = 1.0
    amplitude_rad_s: Positive = 1.0
    offset_rad_s: float = 2.0 * pi
    signal: Literal["sine", "step", "chirp", "multisine"] = "sine"
    chirp_end_hz: Positive = 2.0
    """Where a chirp ends that begins at `frequency_hz`."""
    noise_power_nm2_s: NonNegative = 1.0e-4
    """Spectral density of the torque disturbance, (N·m)²·s (printed as (N·m)²)."""
    duration_s: Positive = 10.0
    sample_period_s: SamplePeriod = 0.001
    seed: Annotated[int, Field(ge=0)] = 1

    @property
    def steps(self) -> int:
        """Samples after the first."""
        return round(self.duration_s / self.sample_period_s)

    @model_validator(mode="after")
    def _simulable(self) -> LoopSettings:
        findings: list[Finding] = []
        if not 10 <= self.steps <= MAX_SAMPLES:
            findings.append(("duration_s", f"gives {self.steps} samples; 10 to {MAX_SAMPLES} are possible"))
        if self.frequency_hz * self.sample_period_s > 0.1:
            findings.append(("frequency_hz", "fewer than ten samples a period: " + _SHORTER))
        share = self.kp_nm_s_rad * self.sample_period_s / self.inertia_kg_m2
        if share > _MAX_GAIN:
            findings.append(("kp_nm_s_rad", f"Kp·Ts/J = {share:.2g} is above {_MAX_GAIN}: {_SHORTER}"))
        stiff = self.dahl_stiffness_nm_rad * self.sample_period_s**2 / self.inertia_kg_m2
        if self.friction == "dahl" and stiff > LARGEST_BRISTLE_STEP:
            findings.append(
                ("dahl_stiffness_nm_rad", f"σ·Ts²/J = {stiff:.2g} is above {LARGEST_BRISTLE_STEP}: {_SHORTER}")
            )
        refuse_if(findings)
        return self


FACTORS = (
    "inertia_kg_m2", "viscous_nm_s_rad", "coulomb_nm", "dahl_stiffness_nm_rad", "kp_nm_s_rad", "ki_nm_rad",
    "frequency_hz", "amplitude_rad_s", "offset_rad_s", "noise_power_nm2_s",
)
"""What may differ from run to run of one design."""

SYMBOLS = {
    "J": "inertia_kg_m2", "B": "viscous_nm_s_rad", "Fc": "coulomb_nm", "sigma": "dahl_stiffness_nm_rad",
    "Kp": "kp_nm_s_rad", "Ki": "ki_nm_rad", "f": "frequency_hz", "A": "amplitude_rad_s", "offset": "offset_rad_s",
    "P_noise": "noise_power_nm2_s", "T": "duration_s", "Ts": "sample_period_s",
}
"""Short names, as formulas write them; taken by `--set` and by factors."""

LABELS = {
    "inertia_kg_m2": "J, kg·m²", "viscous_nm_s_rad": "B, N·m·s/rad", "coulomb_nm": "F$_c$, N·m",
    "dahl_stiffness_nm_rad": "σ, N·m/rad", "kp_nm_s_rad": "K$_p$, N·m·s/rad", "ki_nm_rad": "K$_i$, N·m/rad",
    "frequency_hz": "f, Hz", "amplitude_rad_s": "amplitude, rad/s", "offset_rad_s": "offset, rad/s",
    "noise_power_nm2_s": "noise, (N·m)²·s",
}
"""For the axes of pictures."""


def full_name(name: str) -> str:
    """A symbol's field, or the name itself."""
    return SYMBOLS.get(name, name)


def changed(settings: LoopSettings, **values: object) -> LoopSettings:
    """One run with some values replaced, checked again; what a subclass adds is left behind."""
    kept = {name: getattr(settings, name) for name in LoopSettings.model_fields}
    return LoopSettings.model_validate(kept | values)
