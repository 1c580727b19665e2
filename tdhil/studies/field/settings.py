"""Settings of the field studies, for users to copy and change. SI at the motor shaft, units in the names."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from profiles import DataModel, Positive

NotNegative = Annotated[float, Field(ge=0)]
Tones = Annotated[tuple[Positive, ...], Field(min_length=2, max_length=24)]
Gains = Annotated[tuple[Positive, ...], Field(min_length=3, max_length=24)]


class SimulatedRig(DataModel):
    """Rig at the other end of the bus. Identification receives none of these values.

    The reporting lags are those that reproduce the published slopes with one inertia (notes: 0.403 and 0.151 s); J, B
    and Coulomb friction of the real rig are not published.
    """

    inertia_kg_m2: Positive = 104.0
    viscous_nm_s_rad: NotNegative = 8.0
    coulomb_nm: NotNegative = 60.0
    speed_lag_s: NotNegative = Field(default=0.40, description="s; first-order lag on the reported speed")
    torque_lag_s: NotNegative = Field(default=0.15, description="s; first-order lag on the reported torque")
    loop_filter_s: NotNegative = Field(default=0.02, description="s; speed filter inside the drive's speed loop")
    loop_torque_lag_s: NotNegative = Field(default=0.01, description="s; from demanded to true torque")


class FieldSettings(DataModel):
    """Common settings of all field studies."""

    seed: int = Field(default=1, ge=0, le=2**31 - 1000, description="repeats the whole study, to the last sample")
    rate_hz: float = Field(default=100.0, ge=20, le=500, description="cycles per second")
    torque_limit_nm: Positive = Field(default=400.0, description="N·m; of drive, plan and guard")
    rig: SimulatedRig = SimulatedRig()


class Tone(DataModel):
    """Settings of one record of figure 22. In torque mode the drive's speed loop does not oppose the motion."""

    frequency_hz: Positive
    mode: Literal["speed", "torque"] = "speed"
    periods: int | None = Field(default=None, ge=2, le=10_000, description="settling included; default: 100 s of them")


class SlopeSettings(FieldSettings):
    """Settings of figure 22: one record for each frequency."""

    seed: int = 3
    kp_nm_s_rad: Positive = Field(default=300.0, description="P of the drive's speed loop")
    ki_nm_rad: Positive = Field(default=300.0, description="I of the drive's speed loop")
    confidence: float = Field(default=0.95, gt=0.5, lt=1, description="of the joint fit's interval")
    tones: Annotated[tuple[Tone, ...], Field(min_length=3, max_length=24)] = (
        Tone(frequency_hz=0.1),
        Tone(frequency_hz=0.3),
        Tone(frequency_hz=0.5),
        Tone(frequency_hz=1.0, mode="torque"),
    )


class LoopPair(DataModel):
    """Gains of the drive's speed loop."""

    kp_nm_s_rad: Positive
    ki_nm_rad: Positive


class ScatterSettings(FieldSettings):
    """Settings of figure 19: the paper's method with several gains of the speed loop, one of them repeated."""

    torque_limit_nm: Positive = Field(default=500.0, description="N·m; P 300 with I 2500 rings, and takes above 400")
    frequency_hz: Positive = 0.3
    amplitude_rad_s: Positive = 0.8
    offset_rad_s: Positive = 2.5
    measured_s: Positive = Field(default=30.0, description="s of whole periods, after settling")
    loops: Annotated[tuple[LoopPair, ...], Field(min_length=2, max_length=12)] = (
        LoopPair(kp_nm_s_rad=300.0, ki_nm_rad=300.0),
        LoopPair(kp_nm_s_rad=150.0, ki_nm_rad=300.0),
        LoopPair(kp_nm_s_rad=1500.0, ki_nm_rad=300.0),
        LoopPair(kp_nm_s_rad=300.0, ki_nm_rad=1000.0),
        LoopPair(kp_nm_s_rad=300.0, ki_nm_rad=2500.0),
    )
    repeats: int = Field(default=3, ge=2, le=20, description="runs of the first loop, with other seeds")


class AmplitudeSettings(FieldSettings):
    """Settings of figures 20, 21 and 23: a sine in speed mode.

    P 300 and I 200 are the best of the published sweeps. The input amplitude is the sum of the published figures at 1
    Hz, 0.0992 + 0.8414 rad/s.
    """

    torque_limit_nm: Positive = 1200.0
    amplitude_rad_s: Positive = 0.9406
    offset_rad_s: Positive = 2.5
    measured_s: Positive = Field(default=20.0, description="s of whole periods, after settling")
    kp_nm_s_rad: Positive = 300.0
    ki_nm_rad: Positive = 200.0


class GainSweepSettings(AmplitudeSettings):
    """Settings of figures 20 and 21. The paper does not state the frequency; 0.2 Hz is that of its simulations
    (Table 7).
    """

    frequency_hz: Positive = 0.2
    other_tones_hz: Tones = Field(default=(0.1, 0.3), description="shown from the linear loop only")


class FieldKpSweepSettings(GainSweepSettings):
    """Settings of figure 20: over P."""

    kp_values_nm_s_rad: Gains = (150.0, 225.0, 300.0, 450.0, 700.0, 1000.0, 1500.0)


class FieldKiSweepSettings(GainSweepSettings):
    """Settings of figure 21: over I."""

    ki_values_nm_rad: Gains = (200.0, 350.0, 500.0, 800.0, 1200.0, 1800.0, 2500.0)


class ToneSweepSettings(AmplitudeSettings):
    """Settings of figure 23: over frequency."""

    frequencies_hz: Tones = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
