r"""Drill string of string.yaml as the load of the top drive: exact transmission lines, section by section.

::

    one metre of pipe    m = ρ I_p  kg·m,   y = 1/(G I_p)  rad/(N·m²),   d  N·m·s/rad per m    I_p = π (OD⁴ − ID⁴)/32

    −∂τ/∂x = m ∂ω/∂t + d ω        −∂ω/∂x = y ∂τ/∂t          x downwards; τ N·m is the torque passed downwards

**Derivation.** In the Laplace domain, both equations together give ω'' = γ² ω with γ² = (m s + d) y s. The solutions
are two waves e^∓γx, in which τ = ±Z ω with Z = (m s + d)/γ. Without drag, Z is real: the characteristic impedance
ζ = √(m/y) = I_p √(Gρ). The waves travel at c = 1/√(m y) = √(G/ρ). For both ends of a section of length L they give

    ⎡ω⎤       ⎡ cosh γL      y s S ⎤ ⎡ω⎤
    ⎢ ⎥     = ⎢                    ⎥ ⎢ ⎥          S = sinh(γL)/γ
    ⎣τ⎦ top   ⎣ (m s + d) S  cosh γL⎦ ⎣τ⎦ bottom

The determinant of this matrix is 1. cosh and S are even in γ, so each entry is a power series in s. It has no branch
cuts and no poles; the search for roots depends on this. The matrix of several sections is the product of their
matrices. At the bottom, τ = (s J_L + B_b) ω while the bit turns, and ω = 0 while it is stuck. This gives (ω, τ) at the
top up to one common factor, and

    Z_s(s) = τ/ω        k = 1/Σ y L        T = Σ L/c        the echo of a change at the top comes back after 2T

**Tool joints** are much shorter than every wavelength of interest. So the inertia per metre and the compliance per
metre are means over a joint of pipe, weighted by the share of length. (Waves: any text on transmission lines;
S. L. Chen and M. Géradin (1995) for drill strings.)

All quantities are at the main shaft, from which the string hangs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
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
"""Viscous drag of mud on 5 inch pipe, N·m·s/rad per metre: the order of magnitude in simulations; not measured."""
WALL_FRICTION_KINETIC, WALL_FRICTION_STATIC = 0.2, 0.3
"""Friction coefficients of steel on rock or casing in mud: the order of magnitude in torque-and-drag programs; not
measured on this well."""
WALL_FRICTION_FACTOR = 1.5
"""Tolerance of the friction coefficients as a factor, up or down. From standstill it gives 0.20 to 0.45.
C. A. Johancsik, D. B. Friesen and R. Dawson (1984), SPE-11380-PA, fitted 0.25 to 0.40 in water-base mud to torque and
hook load."""
SHEAR_RANGE_PA = (61e9, 80e9)
"""Range of the shear modulus G of a steel string, Pa: 79 to 80 GPa by the handbook; U. J. Aarsnes and R. Shor (2018)
fitted 61 GPa for pipe and 67 GPa for collars to field data, tool joints and connections included."""
STATED_SHEAR_TOLERANCE = 0.05
"""Relative tolerance of a stated shear modulus G. A stated G is taken as fitted to field data."""
LENGTH_TOLERANCE = 0.01
"""Relative tolerance of the length: one stand of 28 m on a string of 3,000 m."""
WORN_POLAR_SHARE = 0.85
"""Polar moment of area of worn pipe over that of new pipe: an assumption. 5 inch pipe of 19.5 lb/ft with 87.5 % of its
wall left, worn evenly outside, has it. API RP 7G permits 80 % of the wall in premium class: a share of 0.76."""
PIPE_OUTER_TOLERANCE = 0.0075
"""Relative tolerance of the outside diameter of new pipe of 4 inches and more. API Spec 5D (1991), 6.7: −0.75 %."""
PIPE_INNER_TOLERANCE = 0.0075
"""Relative tolerance of the inside diameter of new pipe. API Spec 5D limits it by the outside diameter and the weight
only; with this value, which is an assumption, the wall of 5 inch pipe keeps to −10 % (API: −12.5 %)."""
DRAG_FACTOR = 2.5
"""Tolerance of the mud's drag as a factor, up or down. The drag is a guess in every string file."""
BOTTOM_TOLERANCE = 0.10
"""Relative tolerance of the inertia at the bottom, and of the polar moment of area of the bottom-hole assembly if it is
stated as sections. It is an assumption: 2.5 % of the diameter of a collar."""
BIT_TORQUE_TOLERANCE, STRIBECK_FACTOR, NOISE_FACTOR = 0.15, 1.25, 1.5
"""Tolerances of a stated bit: torque (relative), Stribeck speed and noise (factors, up or down). They are assumptions,
like the bit itself: a search of the literature found no measured scatter."""
BIT_NOISE_SHARE = 0.08
"""Root mean square of the bit's random torque, divided by its Coulomb torque. It is an assumption: 200 N·m for a bit of
2,500 N·m. A search of the literature found no measured figure (docs/reference/string.md). A log of steady drilling
gives the value of a real bit."""
NOISE_CORRELATION_S = 0.2
"""Correlation time of the bit's random torque, s. It is an assumption. If the noise reaches frequencies above the
string's lowest modes, the value has little influence."""

_Share = Annotated[float, Field(ge=0.0, le=0.9)]
_Length = Annotated[float, Field(gt=0.0, le=20_000.0)]
_Diameter = Annotated[float, Field(gt=0.0, le=2.0)]
_NotNegative = Annotated[float, Field(ge=0.0, le=1e9)]
_PositiveNumber = Annotated[float, Field(gt=0.0, le=1e12)]


class ToolJoints(DataModel):
    """Tool joints: the thick ends of the joints of pipe, averaged over the section."""

    length_share: float = Field(gt=0.0, lt=1.0, description="share of the section's length that is tool joint")
    outer_diameter_m: _Diameter
    inner_diameter_m: float = Field(ge=0.0, le=2.0)

    @classmethod
    def contradictions(cls, values: Mapping[str, Any]) -> list[Finding]:
        """Report a bore that is not smaller than the outer diameter."""
        return _bore(values)


class PipeSection(DataModel):
    """One uniform section of pipe or collar."""

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
        """Report a bore that is not smaller than the outer diameter, and a length that is stated twice or missing."""
        length, stiffness = values.get("length_m", ...), values.get("stiffness_nm_rad", ...)
        found = _bore(values)
        if length is None and stiffness is None:
            found.append(("", "needs length_m, or the stiffness_nm_rad that was identified"))
        if isinstance(length, float) and isinstance(stiffness, float):
            found.append(("stiffness_nm_rad", "and length_m say the same thing; keep one"))
        return found


class BottomEnd(DataModel):
    """Bottom end of the string: an inertia, or sections of a bottom-hole assembly, and the bit's friction.

    The keys are the same as in plant.yaml. Without ``coulomb_nm`` no bit is stated, and no critical speeds are
    computed.
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
        """Report a bottom without inertia, an incomplete friction law, and a static torque below the Coulomb torque."""
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
    """Tolerances of string and bit about the values in string.yaml. Each is relative: 0.1 is 10 %."""

    length: _Share = LENGTH_TOLERANCE
    shear_modulus: _Share | None = Field(
        default=None, description="of shear_modulus_pa; default 61 to 80 GPa, or 5 % of a value that is stated")
    wear: _Share = Field(default=1.0 - WORN_POLAR_SHARE, description="loss of polar moment of area, at most")
    outer_diameter: _Share | None = Field(
        default=None, description="of the pipe; default 0.75 %. If it or inner_diameter is stated, wear counts only if"
        " it is stated too")
    inner_diameter: _Share | None = Field(default=None, description="of the pipe; default 0.75 %")
    density: _Share | None = Field(
        default=None, description="of density_kg_m3, for calibrate torque --known-pipe; default 0.5 %")
    drag: Annotated[float, Field(ge=0.0, le=9.0)] = Field(
        default=DRAG_FACTOR - 1.0, description="1.5 is a factor of 2.5, up or down")
    wall_friction: Annotated[float, Field(ge=0.0, le=9.0)] = Field(
        default=WALL_FRICTION_FACTOR - 1.0, description="of both friction coefficients; 0.5 is a factor of 1.5")
    bottom_inertia: _Share = BOTTOM_TOLERANCE
    bit_torque: _Share = BIT_TORQUE_TOLERANCE
    stribeck_speed: _Share = STRIBECK_FACTOR - 1.0
    noise: _Share = NOISE_FACTOR - 1.0


class StringFile(DataModel):
    """Content of string.yaml."""

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
    """Uniform section as a transmission line of torsional waves."""

    length_m: float
    inertia_kg_m: float
    """Inertia m per metre, kg·m²/m."""
    compliance_rad_nm_m: float
    """Compliance y per metre, rad/(N·m) per m."""
    drag_nm_s_rad_m: float
    """Viscous drag d per metre, N·m·s/rad per m."""
    coulomb_nm_m: float = 0.0
    """Kinetic dry friction on the wall of the hole, N·m per metre."""
    static_nm_m: float = 0.0
    """Static dry friction on the wall of the hole, N·m per metre."""
    outer_share: float = 1.0
    """OD⁴/(OD⁴ − ID⁴): the polar moment of area grows by 4 times this share if OD grows alone. 1: a solid bar."""
    in_bottom: bool = False
    """True: a section of the bottom-hole assembly."""

    @property
    def has_friction(self) -> bool:
        """Return whether the line has drag or dry friction."""
        return self.drag_nm_s_rad_m > 0.0 or self.coulomb_nm_m > 0.0

    @property
    def impedance_nm_s_rad(self) -> float:
        """Characteristic impedance ζ without drag, N·m·s/rad."""
        return sqrt(self.inertia_kg_m / self.compliance_rad_nm_m)

    @property
    def speed_m_s(self) -> float:
        """Speed c of the waves, m/s."""
        return 1.0 / sqrt(self.inertia_kg_m * self.compliance_rad_nm_m)

    @property
    def delay_s(self) -> float:
        """Travel time of a wave from end to end, s."""
        return self.length_m / self.speed_m_s


@dataclass(frozen=True)
class StringTolerance:
    """Tolerances of string and bit about the stated values: relative half-widths, and factors up or down."""

    length: float = LENGTH_TOLERANCE
    shear: tuple[float, float] = (1.0 - STATED_SHEAR_TOLERANCE, 1.0 + STATED_SHEAR_TOLERANCE)
    """Smallest and largest G, as factors on the stated one."""
    polar: tuple[float, float] = (WORN_POLAR_SHARE, 1.0)
    """Smallest and largest polar moment of area of worn pipe, as factors on that of new pipe."""
    drag_factor: float = DRAG_FACTOR
    bottom_inertia: float = BOTTOM_TOLERANCE
    bit_torque: float = BIT_TORQUE_TOLERANCE
    stribeck_factor: float = STRIBECK_FACTOR
    noise_factor: float = NOISE_FACTOR
    outer_diameter: float = PIPE_OUTER_TOLERANCE
    inner_diameter: float = PIPE_INNER_TOLERANCE
    wall_friction_factor: float = WALL_FRICTION_FACTOR


STRING_AS_USUAL = StringTolerance()
"""Default tolerances of a stated string."""
IDENTIFIED_STRING = StringTolerance(0.0, (1.0, 1.0), (1.0, 1.0), 2.0, 0.0, outer_diameter=0.0, inner_diameter=0.0)
"""Tolerances of an identified string: k, f and J_L are drawn from their own intervals, the losses from a factor."""
EXACT_STRING = StringTolerance(0.0, (1.0, 1.0), (1.0, 1.0), 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0)
"""Tolerances of a string that is known exactly, such as a simulated one."""


@dataclass(frozen=True)
class BitFriction:
    """Friction of the bit: T_f = sgn ω (F_c + (F_s − F_c) e^−(ω/ω_s)²) while it turns, up to F_s while it sticks."""

    coulomb_nm: float
    static_nm: float
    stribeck_speed_rad_s: float
    noise_nm: float = 0.0
    """Root mean square of the random part of the torque, N·m."""
    noise_correlation_s: float = NOISE_CORRELATION_S
    torque_per_weight_nm_kn: float | None = None
    """Coulomb torque per weight on bit, N·m/kN."""

    def describe(self) -> str:
        """Return a short description of the bit, to stand beside every figure that depends on it."""
        if self.static_nm == self.coulomb_nm:
            return f"Coulomb {self.coulomb_nm:g} N·m"
        return (f"static {self.static_nm:g} N·m, Coulomb {self.coulomb_nm:g} N·m, "
                f"Stribeck speed {self.stribeck_speed_rad_s:g} rad/s")


@dataclass(frozen=True)
class DrillString:
    """Drill string: lines from the top down, and the inertia, friction and bit at the lower end of the last line."""

    lines: tuple[WaveLine, ...]
    bottom_inertia_kg_m2: float
    bottom_viscous_nm_s_rad: float = 0.0
    bit: BitFriction | None = None
    name: str | None = None
    tolerance: StringTolerance = STRING_AS_USUAL
    """Tolerances of the true string about these values."""
    supposed: bool = False
    """True: the waves and their losses are assumed, because an identified spring does not show them."""

    @property
    def impedance_nm_s_rad(self) -> float:
        """Characteristic impedance ζ of the topmost line, N·m·s/rad: the top drive's load until the first echo."""
        return self.lines[0].impedance_nm_s_rad

    @property
    def stiffness_nm_rad(self) -> float:
        """Stiffness k of the whole string as a spring, bottom-hole assembly included, N·m/rad."""
        return 1.0 / sum(line.length_m * line.compliance_rad_nm_m for line in self.lines)

    @property
    def inertia_kg_m2(self) -> float:
        """Inertia of the whole string below the top drive, as a rigid body, kg·m²."""
        return self.bottom_inertia_kg_m2 + sum(line.length_m * line.inertia_kg_m for line in self.lines)

    @property
    def echo_s(self) -> float:
        """Round-trip time 2T after which the echo of the bottom arrives at the top, s."""
        return 2.0 * sum(line.delay_s for line in self.lines)

    def at_top(self, s: Complex, *, stuck: bool = False) -> tuple[Complex, Complex]:
        """Return (speed, torque) at the top for one motion of the bottom, up to a common factor. Analytic for every s.

        For a turning bit, the speed at the bottom is 1, and its inertia and viscous friction give the torque. If
        ``stuck``, the speed at the bottom is 0 and the torque is 1.
        """
        s = np.asarray(s, dtype=np.complex128)
        one, none = np.ones_like(s), np.zeros_like(s)
        if stuck:
            speed, torque = none, one
        else:
            speed, torque = one, s * self.bottom_inertia_kg_m2 + self.bottom_viscous_nm_s_rad
        return self.carried_up(s, speed, torque)

    def carried_up(self, s: Complex, speed: Complex, torque: Complex) -> tuple[Complex, Complex]:
        """Return (speed, torque) at the top for the given ones at the lower end of the last line."""
        for line in reversed(self.lines):
            series, shunt = line.compliance_rad_nm_m * s, line.inertia_kg_m * s + line.drag_nm_s_rad_m
            square, length = series * shunt, line.length_m
            root = np.sqrt(square)      # γ
            product = root * length
            small = np.abs(product) < 1e-4
            cosh = np.cosh(product)
            # sinh(γL)/γ, by its series if γL is small
            sinh_over = np.where(small, length * (1.0 + square * length**2 / 6.0),
                                 np.sinh(product) / np.where(small, 1.0, root))
            speed, torque = cosh * speed + series * sinh_over * torque, shunt * sinh_over * speed + cosh * torque
        return speed, torque

    def impedance_at(self, s: Complex, *, stuck: bool = False) -> Complex:
        """Return the string's impedance Z_s = τ/ω at the top, N·m·s/rad."""
        speed, torque = self.at_top(s, stuck=stuck)
        return torque / speed


def line_of(section: PipeSection) -> WaveLine:
    """Return the section as a transmission line. A length that is not stated follows from the stiffness k."""
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
    outer4, inner4 = section.outer_diameter_m**4, section.inner_diameter_m**4
    return WaveLine(length, inertia, compliance, section.drag_nm_s_rad_m, kinetic, static, outer4 / (outer4 - inner4))


def _per_metre(section: PipeSection, outer_m: float, inner_m: float) -> tuple[float, float]:
    polar = pi * (outer_m**4 - inner_m**4) / 32.0
    return section.density_kg_m3 * polar, 1.0 / (section.shear_modulus_pa * polar)


def string_of(file: StringFile) -> DrillString:
    """Return the drill string that the file describes."""
    bottom = file.bottom
    bit = None
    if bottom.coulomb_nm is not None:
        static = bottom.static_nm if bottom.static_nm is not None else bottom.coulomb_nm
        speed = bottom.stribeck_speed_rad_s if bottom.stribeck_speed_rad_s is not None else inf
        noise = BIT_NOISE_SHARE * bottom.coulomb_nm if bottom.noise_nm is None else bottom.noise_nm
        bit = BitFriction(bottom.coulomb_nm, static, speed, noise, bottom.noise_correlation_s,
                          bottom.torque_per_weight_nm_kn)
    sections = (*file.sections, *bottom.sections)
    lines = (*(line_of(section) for section in file.sections),
             *(replace(line_of(section), in_bottom=True) for section in bottom.sections))
    stated = file.tolerance or ToleranceFile()
    # without a stated G, the range is that of all values fitted to field data
    low, high = (one / STEEL_SHEAR_MODULUS_PA for one in SHEAR_RANGE_PA)
    if stated.shear_modulus is not None:
        low, high = 1.0 - stated.shear_modulus, 1.0 + stated.shear_modulus
    elif any(section.shear_modulus_pa != STEEL_SHEAR_MODULUS_PA for section in sections):
        low, high = 1.0 - STATED_SHEAR_TOLERANCE, 1.0 + STATED_SHEAR_TOLERANCE
    outer, inner = stated.outer_diameter, stated.inner_diameter
    # diameters with a stated tolerance are measured ones, and contain the wear
    worn = (outer is None and inner is None) or "wear" in stated.model_fields_set
    tolerance = StringTolerance(
        stated.length, (low, high), (1.0 - stated.wear if worn else 1.0, 1.0), 1.0 + stated.drag,
        stated.bottom_inertia, stated.bit_torque, 1.0 + stated.stribeck_speed, 1.0 + stated.noise,
        PIPE_OUTER_TOLERANCE if outer is None else outer, PIPE_INNER_TOLERANCE if inner is None else inner,
        1.0 + stated.wall_friction)
    return DrillString(lines, bottom.inertia_kg_m2, bottom.viscous_nm_s_rad, bit, file.name, tolerance=tolerance)


def load_string(path: Path) -> DrillString:
    """Read string.yaml. Raises `DataFileError` with every problem and its line."""
    return string_of(load_model(path, StringFile))


SPRING_SHARE, SPRING_LOSS = 0.1, 0.03
"""Assumptions for a spring of unknown mass: its inertia as a share of the load's inertia, and the damping ratio of its
first wave. Waves need an inertia. Without damping, the stiffest loops would oscillate on waves that no measurement
shows."""


def spring_and_mass(
    stiffness_nm_rad: float, antiresonance_hz: float, damping_nm_s_rad: float = 0.0, name: str | None = None
) -> DrillString:
    """Return an identified load on a spring as a string without a bit.

    With its top held, the load oscillates at ``antiresonance_hz``. The spring is one light line with stiffness k and
    the inertia J_s, `SPRING_SHARE` of the load. A mass m on such a line oscillates like m + J_s/3 on a massless spring,
    to second order in J_s/m (Rayleigh). The exact relation ωT tan ωT = J_s/m is used here. With the top held, one third
    of the line's loss acts at the load. The rest of the spring's ``damping_nm_s_rad`` is placed at the load, where it
    has the same effect. (The line alone gives this oscillation a damping ratio of 0.010.)
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
"""Least inertia of a pipe, as a share of the load's inertia. Below it, k, f and J_L do not determine the characteristic
impedance."""


def identified_string(
    stiffness_nm_rad: float, antiresonance_hz: float, load_inertia_kg_m2: float, damping_nm_s_rad: float = 0.0,
    name: str | None = None,
) -> DrillString | None:
    """Return the uniform pipe with stiffness k whose load J_L oscillates at f with the top held; None if none exists.

    The travel time T follows from ωT tan ωT = kT²/J_L with ω = 2πf, that is tan ωT = kT/(ω J_L). Then ζ = kT and
    J_s = kT². If J_L is already k/ω² or nearly so, no inertia is left for the pipe, and the result is None.
    """
    omega = 2.0 * pi * antiresonance_hz
    light = stiffness_nm_rad / omega**2 - load_inertia_kg_m2      # about J_s/3
    if light < LEAST_PIPE_SHARE / 3.0 * load_inertia_kg_m2:
        return None
    low, high = 1e-6, (0.5 - 1e-9) * pi
    for _ in range(200):
        x = 0.5 * (low + high)
        # below the root, (x tan x)/x² is less than k/(ω² J_L)
        low, high = (x, high) if tan(x) / x < stiffness_nm_rad / (omega**2 * load_inertia_kg_m2) else (low, x)
    delay_s = 0.5 * (low + high) / omega
    inertia = stiffness_nm_rad * delay_s**2
    drag = max(2.0 * SPRING_LOSS * inertia * pi / delay_s if damping_nm_s_rad <= 0.0 else 0.0,
               min(3.0 * damping_nm_s_rad, 2.0 * SPRING_LOSS * inertia * pi / delay_s))
    line = WaveLine(1.0, inertia, 1.0 / stiffness_nm_rad, drag)
    return DrillString((line,), load_inertia_kg_m2, max(0.0, damping_nm_s_rad - drag / 3.0), name=name,
                       tolerance=IDENTIFIED_STRING)
