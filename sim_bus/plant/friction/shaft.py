"""One inertia: moment, friction, constant load. A rig has one, or one at each end of a string."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from profiles import NonNegative, Positive, Validated, refuse_if


class ShaftParams(Validated):
    """One inertia with viscous friction and one model of dry friction. Parameters of other models are ignored.

    ``coulomb_nm`` of 0 switches dry friction off in any model.
    """

    inertia_kg_m2: Positive = 104.0
    viscous_nm_s_rad: NonNegative = 8.0
    coulomb_nm: NonNegative = 60.0
    """F_c, dry friction of a sliding shaft, N·m."""
    friction: Literal["coulomb", "stribeck", "dahl", "lugre"] = "coulomb"
    static_nm: NonNegative = 80.0
    """F_s, breakaway torque, N·m; Stribeck and LuGre."""
    stribeck_speed_rad_s: Positive = 0.1
    """ω_s, speed over which friction falls from F_s to F_c, rad/s; Stribeck and LuGre."""
    dahl_stiffness_nm_rad: Positive = 5000.0
    lugre_stiffness_nm_rad: Positive = 20000.0
    """σ0, stiffness of the bristle, N·m/rad."""
    lugre_damping_nm_s_rad: NonNegative = 500.0
    """σ1, damping of the bristle while it bends, N·m·s/rad; σ2 is ``viscous_nm_s_rad``."""
    load_nm: float = 0.0
    """Constant load against positive speed, N·m."""

    @model_validator(mode="after")
    def _breakaway_is_not_below_sliding(self) -> Self:
        if self.friction in {"stribeck", "lugre"} and self.static_nm < self.coulomb_nm:
            refuse_if([("static_nm", f"breakaway torque can't be below coulomb_nm ({self.coulomb_nm:g}) "
                                     f"with friction: {self.friction}")])
        return self


class Harmonic(Validated):
    """Torque a·cos(nθ + φ) against positive rotation, θ the angle of the motor's shaft: cogging, eccentricity."""

    order: Annotated[int, Field(ge=1, le=1000)] = 1
    """n, periods of the torque per turn of the shaft."""
    amplitude_nm: NonNegative = 0.0
    phase_rad: float = 0.0


class MotorEnd(ShaftParams):
    """The inertia on the motor's shaft."""

    added_inertia_kg_m2: NonNegative = 0.0
    """Inertia of a known body that is bolted to the shaft, in addition to ``inertia_kg_m2``."""
    harmonics: tuple[Harmonic, ...] = Field(default=(), strict=False)      # a YAML list is no tuple
    """Torque that depends on the shaft's angle."""
