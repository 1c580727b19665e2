r"""Drill string of string.yaml as a load of the top drive: exact transmission lines, section by section.

::

    one metre of pipe    m = ρ I_p  kg·m,   y = 1/(G I_p)  rad/(N·m²),   d  N·m·s/rad per m    I_p = π (OD⁴ − ID⁴)/32

    −∂τ/∂x = m ∂ω/∂t + d ω        −∂ω/∂x = y ∂τ/∂t          x downwards; τ N·m is what is handed down

**Derivation.** In Laplace's s both together give ω'' = γ² ω with γ² = (m s + d) y s: two waves e^∓γx, in which τ = ±Z ω
with Z = (m s + d)/γ. Without drag Z is real, the characteristic impedance ζ = √(m/y) = I_p √(Gρ), and the waves run
at c = 1/√(m y) = √(G/ρ). Fitted to both ends of a section of length L they give

    ⎡ω⎤       ⎡ cosh γL      y s S ⎤ ⎡ω⎤
    ⎢ ⎥     = ⎢                    ⎥ ⎢ ⎥          S = sinh(γL)/γ
    ⎣τ⎦ top   ⎣ (m s + d) S  cosh γL⎦ ⎣τ⎦ bottom

whose determinant is 1. cosh and S are even in γ, so that each entry is a power series in s: there are no branch cuts
and no poles anywhere, which finding roots rests on. Sections one below another are products of their matrices. At the
bottom τ = (s J_L + B_b) ω while it turns, ω = 0 while it is stuck; hence (ω, τ) at the top up to one common factor, and

    Z_s(s) = τ/ω        k = 1/Σ y L        T = Σ L/c        the echo of a change at the top comes back after 2T

**Tool joints** are short against every wave that matters: over the length of a joint of pipe the inertia per metre and
the compliance per metre are means, weighted by the share of length. (Waves: any text on lines, as S. L. Chen and
M. Géradin (1995) for strings.)

Everything here is at the shaft that the string hangs on, the main shaft.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, pi, sqrt, tan
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from profiles import DataModel, Finding, load_model

Complex = NDArray[np.complex128]

STEEL_SHEAR_MODULUS_PA = 79.3e9
STEEL_DENSITY_KG_M3 = 7850.0
MUD_DRAG_NM_S_RAD_M = 0.005
"""Viscous drag of mud on 5 inch pipe, of the order that simulations use; not measured."""
WALL_FRICTION_KINETIC, WALL_FRICTION_STATIC = 0.2, 0.3
"""Friction coefficients of steel on rock or casing in mud, of the order that torque-and-drag programs use; not measured
on this well."""
SHEAR_RANGE_PA = (61e9, 80e9)
"""Range of the shear modulus G of a steel string, Pa: 79 to 80 GPa by the handbook; U. J. Aarsnes and R. Shor (2018)
fitted 61 GPa for pipe and 67 GPa for collars to field data, tool joints and connections included."""
STATED_SHEAR_TOLERANCE = 0.05
"""Relative, of a G that was stated because it was fitted."""
LENGTH_TOLERANCE = 0.01
"""Relative: a stand of 28 m on a string of 3,000 m."""
WORN_POLAR_SHARE = 0.85
"""Polar moment of area of pipe with 80 % of its wall left (API RP 7G, premium class), over that of new pipe."""
DRAG_FACTOR = 2.5
"""Up or down: the mud's drag is a guess in every string file."""
BOTTOM_TOLERANCE = 0.10
BIT_TORQUE_TOLERANCE, STRIBECK_FACTOR, NOISE_FACTOR = 0.15, 1.25, 1.5
"""Tolerances of a stated bit, relative and as factors up or down. They are assumptions, as the bit itself is."""
BIT_NOISE_SHARE = 0.08
"""Root mean square of the bit's random torque over its Coulomb torque: an assumption, 200 N·m on a bit of 2,500 N·m.
A log of steady drilling gives the value of a real bit."""
NOISE_CORRELATION_S = 0.2
"""Correlation time of the bit's random torque, s: an assumption; above the string's lowest modes it hardly matters."""

_Share = Annotated[float, Field(ge=0.0, le=0.9)]
_Length = Annotated[float, Field(gt=0.0, le=20_000.0)]
_Diameter = Annotated[float, Field(gt=0.0, le=2.0)]
_NotNegative = Annotated[float, Field(ge=0.0, le=1e9)]
_PositiveNumber = Annotated[float, Field(gt=0.0, le=1e12)]


class ToolJoints(DataModel):
    """The thick ends of the joints of pipe, as a mean over the section."""

    length_share: float = Field(gt=0.0, lt=1.0, description="share of the section's length that is tool joint")
    outer_diameter_m: _Diameter
    inner_diameter_m: float = Field(ge=0.0, le=2.0)

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """A bore wider than the joint."""
        return _bore(values)


class PipeSection(DataModel):
    """One uniform stretch of pipe or collar."""

    length_m: _Length | None = Field(default=None, description="m; or stiffness_nm_rad")
    stiffness_nm_rad: _PositiveNumber | None = Field(
        default=None, description="N·m/rad of the whole section, as identified, where its length isn't known"
    )
    outer_diameter_m: _Diameter
    inner_diameter_m: float = Field(ge=0.0, le=2.0)
    shear_modulus_pa: Annotated[float, Field(ge=1e9, le=1e12)] = STEEL_SHEAR_MODULUS_PA
    density_kg_m3: Annotated[float, Field(ge=500.0, le=3e4)] = STEEL_DENSITY_KG_M3
    drag_nm_s_rad_m: _NotNegative = MUD_DRAG_NM_S_RAD_M
    side_force_n_m: _NotNegative = Field(
        default=0.0, description="N per metre with which the pipe lies on the wall of a deviated hole"
    )
    friction_kinetic: Annotated[float, Field(ge=0.0, le=2.0)] = Field(
        default=WALL_FRICTION_KINETIC, description="friction coefficient on that wall while the pipe turns"
    )
    friction_static: Annotated[float, Field(ge=0.0, le=2.0)] = Field(
        default=WALL_FRICTION_STATIC, description="friction coefficient on that wall from standstill"
    )
    tool_joints: ToolJoints | None = None

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """A bore wider than the pipe; a length said twice, or not at all."""
        length, stiffness = values.get("length_m", ...), values.get("stiffness_nm_rad", ...)
        found = _bore(values)
        if length is None and stiffness is None:
            found.append(("", "needs length_m, or the stiffness_nm_rad that was identified"))
        if isinstance(length, float) and isinstance(stiffness, float):
            found.append(("stiffness_nm_rad", "and length_m say the same thing; keep one"))
        return found


class BottomEnd(DataModel):
    """The bottom end: an inertia, or sections of a bottom-hole assembly, and the bit's friction.

    The words are plant.yaml's. Without ``coulomb_nm`` no bit is stated, and nothing is said of critical speeds.
    """

    inertia_kg_m2: _NotNegative = Field(default=0.0, description="kg·m²; collars and bit as one")
    sections: tuple[PipeSection, ...] = Field(default=(), description="bottom-hole assembly, from the top down")
    viscous_nm_s_rad: _NotNegative = Field(default=0.0, description="N·m·s/rad, of the bit")
    friction: Literal["coulomb", "stribeck"] = "coulomb"
    coulomb_nm: _NotNegative | None = Field(default=None, description="N·m, of a bit that turns fast")
    static_nm: _NotNegative | None = Field(default=None, description="N·m, at which it breaks away")
    stribeck_speed_rad_s: Annotated[float, Field(gt=0.0, le=1e4)] | None = Field(
        default=None, description="rad/s, over which it falls from one to the other (Gaussian)"
    )
    noise_nm: _NotNegative | None = Field(
        default=None, description="N·m, root mean square of the bit's random torque; default 8 % of coulomb_nm"
    )
    noise_correlation_s: Annotated[float, Field(gt=0.0, le=60.0)] = NOISE_CORRELATION_S
    torque_per_weight_nm_kn: Annotated[float, Field(gt=0.0, le=1e4)] | None = Field(
        default=None, description="N·m of coulomb_nm for each kN of weight on bit; the operator's map then has the "
        "weight on bit"
    )

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Nothing that turns; half a friction law; one that rises."""
        found: list[Finding] = []
        if values.get("inertia_kg_m2") == 0.0 and values.get("sections", ...) == ():
            found.append(("", "needs inertia_kg_m2, or sections of a bottom-hole assembly"))
        coulomb, static = values.get("coulomb_nm", ...), values.get("static_nm", ...)
        speed, law = values.get("stribeck_speed_rad_s", ...), values.get("friction", ...)
        if law == "stribeck":
            wanted = (("coulomb_nm", coulomb), ("static_nm", static), ("stribeck_speed_rad_s", speed))
            found += [(name, "friction: stribeck needs it") for name, value in wanted if value is None]
        elif law == "coulomb":
            found += [(name, "belongs to friction: stribeck") for name, value in
                      (("static_nm", static), ("stribeck_speed_rad_s", speed)) if isinstance(value, float)]
        if isinstance(coulomb, float) and isinstance(static, float) and static < coulomb:
            found.append(("static_nm", f"must not be below coulomb_nm, which is {coulomb:g}"))
        return found


class ToleranceFile(DataModel):
    """How far string and bit may differ from what string.yaml states; each relative, 0.1 is 10 %."""

    length: _Share = LENGTH_TOLERANCE
    shear_modulus: _Share | None = Field(
        default=None, description="of shear_modulus_pa; default 61 to 80 GPa, or 5 % of a value that is stated")
    wear: _Share = Field(default=1.0 - WORN_POLAR_SHARE, description="loss of polar moment of area, at most")
    outer_diameter: _Share | None = Field(default=None, description="of the pipe, for calibrate torque --known-pipe")
    inner_diameter: _Share | None = Field(default=None, description="of the pipe, for calibrate torque --known-pipe")
    density: _Share | None = Field(
        default=None, description="of density_kg_m3, for calibrate torque --known-pipe; default 0.5 %")
    drag: Annotated[float, Field(ge=0.0, le=9.0)] = Field(
        default=DRAG_FACTOR - 1.0, description="1.5 is a factor of 2.5, up or down")
    bottom_inertia: _Share = BOTTOM_TOLERANCE
    bit_torque: _Share = BIT_TORQUE_TOLERANCE
    stribeck_speed: _Share = STRIBECK_FACTOR - 1.0
    noise: _Share = NOISE_FACTOR - 1.0


class StringFile(DataModel):
    """string.yaml."""

    name: str | None = Field(default=None, min_length=1, max_length=200)
    sections: Annotated[tuple[PipeSection, ...], Field(min_length=1)]
    bottom: BottomEnd
    tolerance: ToleranceFile | None = None


def _bore(values: Mapping[str, Any]) -> list[Finding]:
    outer, inner = values.get("outer_diameter_m"), values.get("inner_diameter_m")
    if isinstance(outer, float) and isinstance(inner, float) and inner >= outer:
        return [("inner_diameter_m", f"must be less than outer_diameter_m, which is {outer:g}")]
    return []


# ---------------------------------------------------------------------------------------------------------------------

@dataclass(frozen=True)
class WaveLine:
    """A uniform stretch as the waves see it."""

    length_m: float
    inertia_kg_m: float
    """m, per metre: kg·m²/m."""
    compliance_rad_nm_m: float
    """y, per metre: rad/(N·m) per m."""
    drag_nm_s_rad_m: float
    coulomb_nm_m: float = 0.0
    """Kinetic dry friction on the wall of the hole, N·m per metre."""
    static_nm_m: float = 0.0
    """The same, from standstill."""

    @property
    def has_friction(self) -> bool:
        """Return whether anything along the line takes energy."""
        return self.drag_nm_s_rad_m > 0.0 or self.coulomb_nm_m > 0.0

    @property
    def impedance_nm_s_rad(self) -> float:
        """ζ, without drag."""
        return sqrt(self.inertia_kg_m / self.compliance_rad_nm_m)

    @property
    def speed_m_s(self) -> float:
        """Speed c of the waves."""
        return 1.0 / sqrt(self.inertia_kg_m * self.compliance_rad_nm_m)

    @property
    def delay_s(self) -> float:
        """Travel time of a wave from end to end."""
        return self.length_m / self.speed_m_s


@dataclass(frozen=True)
class StringTolerance:
    """How far string and bit may differ from what is stated: relative half-widths, and factors up or down."""

    length: float = LENGTH_TOLERANCE
    shear: tuple[float, float] = (1.0 - STATED_SHEAR_TOLERANCE, 1.0 + STATED_SHEAR_TOLERANCE)
    """Least and largest G, as factors on the stated one."""
    polar: tuple[float, float] = (WORN_POLAR_SHARE, 1.0)
    """Least and largest polar moment of area, as factors on that of the stated diameters."""
    drag_factor: float = DRAG_FACTOR
    bottom_inertia: float = BOTTOM_TOLERANCE
    bit_torque: float = BIT_TORQUE_TOLERANCE
    stribeck_factor: float = STRIBECK_FACTOR
    noise_factor: float = NOISE_FACTOR


STRING_AS_USUAL = StringTolerance()
IDENTIFIED_STRING = StringTolerance(0.0, (1.0, 1.0), (1.0, 1.0), 2.0, 0.0)
"""Tolerance of an identified string: k, f and J_L are drawn from their own intervals, the losses from a factor."""
EXACT_STRING = StringTolerance(0.0, (1.0, 1.0), (1.0, 1.0), 1.0, 0.0, 0.0, 1.0, 1.0)
"""Tolerance of a string that is known exactly, such as a simulated one."""


@dataclass(frozen=True)
class BitFriction:
    """T_f = sgn ω (F_c + (F_s − F_c) e^−(ω/ω_s)²) while it turns, up to F_s while it sticks."""

    coulomb_nm: float
    static_nm: float
    stribeck_speed_rad_s: float
    noise_nm: float = 0.0
    """Root mean square of the torque's random part."""
    noise_correlation_s: float = NOISE_CORRELATION_S
    torque_per_weight_nm_kn: float | None = None
    """Coulomb torque for each kN of weight on bit."""

    def describe(self) -> str:
        """Return the bit in half a line, for every figure that depends on it."""
        if self.static_nm == self.coulomb_nm:
            return f"Coulomb {self.coulomb_nm:g} N·m"
        return (f"static {self.static_nm:g} N·m, Coulomb {self.coulomb_nm:g} N·m, "
                f"Stribeck speed {self.stribeck_speed_rad_s:g} rad/s")


@dataclass(frozen=True)
class DrillString:
    """Lines from the top down, and what turns at the lower end of the last."""

    lines: tuple[WaveLine, ...]
    bottom_inertia_kg_m2: float
    bottom_viscous_nm_s_rad: float = 0.0
    bit: BitFriction | None = None
    name: str | None = None
    tolerance: StringTolerance = STRING_AS_USUAL
    """How far the true string may differ."""
    supposed: bool = False
    """Its waves and their losses are assumed: an identified spring does not show them."""

    @property
    def impedance_nm_s_rad(self) -> float:
        """ζ that the top drive sees until the first echo: the topmost line's."""
        return self.lines[0].impedance_nm_s_rad

    @property
    def stiffness_nm_rad(self) -> float:
        """Stiffness k of the whole as a spring, bottom-hole assembly included."""
        return 1.0 / sum(line.length_m * line.compliance_rad_nm_m for line in self.lines)

    @property
    def inertia_kg_m2(self) -> float:
        """Inertia of everything below the top drive, as if it were stiff."""
        return self.bottom_inertia_kg_m2 + sum(line.length_m * line.inertia_kg_m for line in self.lines)

    @property
    def echo_s(self) -> float:
        """2T: the echo of the bottom comes back after it."""
        return 2.0 * sum(line.delay_s for line in self.lines)

    def at_top(self, s: Complex, *, stuck: bool = False) -> tuple[Complex, Complex]:
        """(speed, torque) at the top for one motion of the bottom, up to a common factor; analytic in all of s.

        Turning: the bottom's speed is 1, under its inertia and viscous friction. ``stuck``: its torque is 1.
        """
        s = np.asarray(s, dtype=np.complex128)
        one, none = np.ones_like(s), np.zeros_like(s)
        if stuck:
            speed, torque = none, one
        else:
            speed, torque = one, s * self.bottom_inertia_kg_m2 + self.bottom_viscous_nm_s_rad
        return self.carried_up(s, speed, torque)

    def carried_up(self, s: Complex, speed: Complex, torque: Complex) -> tuple[Complex, Complex]:
        """(speed, torque) at the top that belong to those at the lower end of the last line."""
        for line in reversed(self.lines):
            series, shunt = line.compliance_rad_nm_m * s, line.inertia_kg_m * s + line.drag_nm_s_rad_m
            cosh, sinh_over = _cosh_and_sinh_over(series * shunt, line.length_m)
            speed, torque = cosh * speed + series * sinh_over * torque, shunt * sinh_over * speed + cosh * torque
        return speed, torque

    def impedance_at(self, s: Complex, *, stuck: bool = False) -> Complex:
        """Z_s = τ/ω at the top, N·m·s/rad."""
        speed, torque = self.at_top(s, stuck=stuck)
        return torque / speed


def _cosh_and_sinh_over(square: Complex, length: float) -> tuple[Complex, Complex]:
    """Cosh γL and sinh(γL)/γ, from γ²."""
    root = np.sqrt(square)
    product = root * length
    small = np.abs(product) < 1e-4
    safe = np.where(small, 1.0, root)
    over = np.where(small, length * (1.0 + square * length**2 / 6.0), np.sinh(product) / safe)
    return np.cosh(product), over


def line_of(section: PipeSection) -> WaveLine:
    """The section as the waves see it; a length that isn't stated is k's."""
    inertia, compliance = _per_metre(section, section.outer_diameter_m, section.inner_diameter_m)
    joints = section.tool_joints
    if joints is not None:
        heavy, stiff = _per_metre(section, joints.outer_diameter_m, joints.inner_diameter_m)
        share = joints.length_share
        inertia = (1.0 - share) * inertia + share * heavy
        compliance = (1.0 - share) * compliance + share * stiff
    if section.length_m is not None:
        length = section.length_m
    else:
        assert section.stiffness_nm_rad is not None
        length = 1.0 / (section.stiffness_nm_rad * compliance)
    radius = 0.5 * max(section.outer_diameter_m, 0.0 if joints is None else joints.outer_diameter_m)
    kinetic = section.friction_kinetic * section.side_force_n_m * radius
    static = max(kinetic, section.friction_static * section.side_force_n_m * radius)
    return WaveLine(length, inertia, compliance, section.drag_nm_s_rad_m, kinetic, static)


def _per_metre(section: PipeSection, outer_m: float, inner_m: float) -> tuple[float, float]:
    polar = pi * (outer_m**4 - inner_m**4) / 32.0
    return section.density_kg_m3 * polar, 1.0 / (section.shear_modulus_pa * polar)


def string_of(file: StringFile) -> DrillString:
    """Return the string of the file, from the top down."""
    bottom = file.bottom
    bit = None
    if bottom.coulomb_nm is not None:
        static = bottom.static_nm if bottom.static_nm is not None else bottom.coulomb_nm
        speed = bottom.stribeck_speed_rad_s if bottom.stribeck_speed_rad_s is not None else inf
        noise = BIT_NOISE_SHARE * bottom.coulomb_nm if bottom.noise_nm is None else bottom.noise_nm
        bit = BitFriction(bottom.coulomb_nm, static, speed, noise, bottom.noise_correlation_s,
                          bottom.torque_per_weight_nm_kn)
    sections = (*file.sections, *bottom.sections)
    lines = tuple(line_of(section) for section in sections)
    return DrillString(lines, bottom.inertia_kg_m2, bottom.viscous_nm_s_rad, bit, file.name,
                       tolerance=_tolerance_of(file, sections))


def _tolerance_of(file: StringFile, sections: tuple[PipeSection, ...]) -> StringTolerance:
    """Return the tolerances of the file. Without a stated G, every value that was fitted in the field is possible."""
    stated = file.tolerance or ToleranceFile()
    shear = tuple(one / STEEL_SHEAR_MODULUS_PA for one in SHEAR_RANGE_PA)
    if stated.shear_modulus is not None:
        shear = (1.0 - stated.shear_modulus, 1.0 + stated.shear_modulus)
    elif any(section.shear_modulus_pa != STEEL_SHEAR_MODULUS_PA for section in sections):
        shear = (1.0 - STATED_SHEAR_TOLERANCE, 1.0 + STATED_SHEAR_TOLERANCE)
    return StringTolerance(
        stated.length, (shear[0], shear[1]), (1.0 - stated.wear, 1.0), 1.0 + stated.drag,
        stated.bottom_inertia, stated.bit_torque, 1.0 + stated.stribeck_speed, 1.0 + stated.noise)


def load_string(path: Path) -> DrillString:
    """Reads string.yaml; `DataFileError` with every problem and its line."""
    return string_of(load_model(path, StringFile))


SPRING_SHARE, SPRING_LOSS = 0.1, 0.03
"""Assumed inertia of a spring of unknown mass, as a share of its load's inertia, since waves need some; and the damping
ratio of its first wave. Without damping the stiffest loops would oscillate on waves that no measurement shows."""


def spring_and_mass(
    stiffness_nm_rad: float, antiresonance_hz: float, damping_nm_s_rad: float = 0.0, name: str | None = None
) -> DrillString:
    """A load on a spring, as identified, without a bit; with its top held it swings at ``antiresonance_hz``.

    One light line with K and its share of the load. A mass m on a line with inertia J_s swings as m + J_s/3 on a
    spring does, to the second order of J_s/m (Rayleigh), and exactly as ωT tan ωT = J_s/m has it; that is used. Of the
    loss along the line a third counts at the load, where the rest of the spring's ``damping_nm_s_rad`` is put: with the
    top held it is the same there. (The line's alone damps that swing by 0.010.)
    """
    swing = 2.0 * pi * antiresonance_hz
    load = stiffness_nm_rad / swing**2
    inertia = SPRING_SHARE * load
    delay_s = sqrt(inertia / stiffness_nm_rad)
    drag = 2.0 * SPRING_LOSS * inertia * pi / delay_s
    line = WaveLine(1.0, inertia, 1.0 / stiffness_nm_rad, drag)
    mass = inertia / (swing * delay_s * tan(swing * delay_s))
    return DrillString((line,), mass, max(0.0, damping_nm_s_rad - drag / 3.0), name=name,
                       tolerance=IDENTIFIED_STRING, supposed=True)


LEAST_PIPE_SHARE = 0.03
"""Least inertia of a pipe, as a share of the load's: below it k, f and J_L do not determine the characteristic
impedance."""


def identified_string(
    stiffness_nm_rad: float, antiresonance_hz: float, load_inertia_kg_m2: float, damping_nm_s_rad: float = 0.0,
    name: str | None = None,
) -> DrillString | None:
    """Return the uniform pipe with stiffness k whose load J_L swings at f with its top held; None: no pipe does.

    ωT tan ωT = kT²/J_L with ω = 2πf, that is tan ωT = kT/(ω J_L), gives the travel time T; ζ = kT and J_s = kT². A
    load that swings as k/ω² does by itself leaves no inertia for the pipe.
    """
    omega = 2.0 * pi * antiresonance_hz
    light = stiffness_nm_rad / omega**2 - load_inertia_kg_m2      # J_s/3, about
    if light < LEAST_PIPE_SHARE / 3.0 * load_inertia_kg_m2:
        return None
    low, high = 1e-6, (0.5 - 1e-9) * pi
    for _ in range(200):
        x = 0.5 * (low + high)
        # x tan x / x² falls short of k/(ω² J_L) below the root
        low, high = (x, high) if tan(x) / x < stiffness_nm_rad / (omega**2 * load_inertia_kg_m2) else (low, x)
    delay_s = 0.5 * (low + high) / omega
    inertia = stiffness_nm_rad * delay_s**2
    drag = max(2.0 * SPRING_LOSS * inertia * pi / delay_s if damping_nm_s_rad <= 0.0 else 0.0,
               min(3.0 * damping_nm_s_rad, 2.0 * SPRING_LOSS * inertia * pi / delay_s))
    line = WaveLine(1.0, inertia, 1.0 / stiffness_nm_rad, drag)
    return DrillString((line,), load_inertia_kg_m2, max(0.0, damping_nm_s_rad - drag / 3.0), name=name,
                       tolerance=IDENTIFIED_STRING)
