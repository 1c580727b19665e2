"""Strict reading of string.yaml, and exact lines compared with closed forms and with the chain of lumps."""

from __future__ import annotations

from math import pi, sqrt, tan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from profiles import DataFileError
from tdhil.soft_torque import (
    BottomEnd,
    ClosedSystem,
    DrillString,
    Interval,
    PipeSection,
    StringFile,
    ToleranceFile,
    TopDrive,
    WaveLine,
    draw_truths,
    load_string,
    spring_and_mass,
    string_modes_hz,
    string_of,
)
from tests.soft_torque.cases import FIVE_INCH, STRING, Pipe, chain_modes, lumped_chain, string_with

GOOD = """\
sections:
  - {length_m: 2500, outer_diameter_m: 0.127, inner_diameter_m: 0.1086,
     tool_joints: {length_share: 0.05, outer_diameter_m: 0.168, inner_diameter_m: 0.095}}
  - {length_m: 200, outer_diameter_m: 0.127, inner_diameter_m: 0.0762}
bottom:
  inertia_kg_m2: 10
  sections: [{length_m: 150, outer_diameter_m: 0.203, inner_diameter_m: 0.0714}]
  friction: stribeck
  static_nm: 5000
  coulomb_nm: 2500
  stribeck_speed_rad_s: 2.5
  viscous_nm_s_rad: 20
"""


def written(tmp_path, text):
    path = tmp_path / "string.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_file_is_read_from_the_top_down(tmp_path):
    string = load_string(written(tmp_path, GOOD))
    assert [round(line.length_m) for line in string.lines] == [2500, 200, 150]
    assert string.lines[2].impedance_nm_s_rad > 10 * string.lines[0].impedance_nm_s_rad
    plain = load_string(written(tmp_path, GOOD.replace("length_share: 0.05", "length_share: 1e-9")))
    # tool joints are heavier and stiffer than the pipe
    assert string.lines[0].inertia_kg_m > plain.lines[0].inertia_kg_m
    assert string.lines[0].compliance_rad_nm_m < plain.lines[0].compliance_rad_nm_m


@pytest.mark.parametrize(("old", "new", "line", "words"), [
    ("inner_diameter_m: 0.0762", "inner_diameter_m: 0.2", 4, "must be less than outer_diameter_m"),
    ("{length_m: 200, ", "{", 4, "needs length_m, or the stiffness_nm_rad"),
    ("length_m: 200,", "length_m: 200, stiffness_nm_rad: 300,", 4, "keep one"),
    ("length_m: 200,", "lenght_m: 200,", 4, "lenght_m"),
    ("  coulomb_nm: 2500\n", "", 5, "friction: stribeck needs it"),
    ("coulomb_nm: 2500", "coulomb_nm: 5500", 9, "must not be below coulomb_nm"),
    ("friction: stribeck", "friction: coulomb", 9, "belongs to friction: stribeck"),
    ("length_m: 200,", "length_m: 200 m,", 4, "write the number alone, in metres"),
])
def test_errors_are_reported_with_their_line(tmp_path, old, new, line, words):
    with pytest.raises(DataFileError) as caught:
        load_string(written(tmp_path, GOOD.replace(old, new)))
    assert any(problem.line == line and words in str(problem) for problem in caught.value.problems), caught.value


def test_a_wrong_entry_is_not_reported_as_missing(tmp_path):
    one = "sections:\n  - {length_m: 9 km, outer_diameter_m: 0.1, inner_diameter_m: 0}\nbottom: {inertia_kg_m2: 9}\n"
    for text, short in ((one, False), ("sections: []\nbottom: {inertia_kg_m2: 9}\n", True)):
        with pytest.raises(DataFileError) as caught:
            load_string(written(tmp_path, text))
        assert ("at least 1 entries" in str(caught.value)) is short


def test_nothing_at_the_bottom_is_refused(tmp_path):
    text = "sections:\n  - {length_m: 1000, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}\nbottom: {}\n"
    with pytest.raises(DataFileError, match="needs inertia_kg_m2, or sections"):
        load_string(written(tmp_path, text))


def test_a_stiffness_in_place_of_a_length(tmp_path):
    text = ("sections:\n  - {stiffness_nm_rad: 314.1278, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}\n"
            "bottom: {inertia_kg_m2: 374}\n")
    assert load_string(written(tmp_path, text)).lines[0].length_m == pytest.approx(3000.0, rel=1e-6)


def test_the_reference_string_by_its_formulas():
    polar = pi / 32 * (0.127**4 - 0.1086**4)
    assert STRING.impedance_nm_s_rad == pytest.approx(polar * sqrt(79.3e9 * 7850), rel=1e-12)
    assert STRING.impedance_nm_s_rad == pytest.approx(296.5, rel=1e-4)
    assert STRING.stiffness_nm_rad == pytest.approx(79.3e9 * polar / 3000, rel=1e-12)
    assert STRING.echo_s == pytest.approx(1.888, abs=5e-4)


def test_modes_with_the_top_held_are_those_of_the_transcendental_equation():
    """Without losses, the modes solve ζ cot(ωL/c) = ω J_L, by bisection between the poles of the cotangent."""
    string = string_with(drag=0.0, viscous_nm_s_rad=0.0)
    delay, impedance = string.echo_s / 2, string.impedance_nm_s_rad
    wanted = []
    for k in range(4):
        low, high = k * pi / delay + 1e-9, (k + 1) * pi / delay - 1e-9
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if impedance / tan(middle * delay) > middle * 374.0 else (low, middle)
        wanted.append(low / (2 * pi))
    modes = ClosedSystem(string).modes(1.1 * wanted[-1])
    assert [mode.frequency_hz for mode in modes] == pytest.approx(wanted, rel=1e-9)
    assert all(abs(mode.damping) < 1e-9 for mode in modes)
    assert wanted[:3] == pytest.approx([0.1299, 0.567, 1.079], abs=1e-3)


def test_fifty_lumps_are_good_to_a_thousandth():
    a, _, _ = lumped_chain([Pipe(3000.0, 0.127, 0.1086)], 374.0, 20.0)
    chain, exact = chain_modes(a, 1.2), ClosedSystem(STRING).modes(1.2)
    assert len(chain) == len(exact) == 3
    for (hertz, damping), mode in zip(chain, exact, strict=True):
        assert hertz == pytest.approx(mode.frequency_hz, rel=1e-3)
        assert damping == pytest.approx(mode.damping, abs=1e-4)


@pytest.mark.parametrize("stuck", [False, True])
def test_sections_of_different_impedance_against_the_chain(tmp_path, stuck):
    joints = ",\n     tool_joints: {length_share: 0.05, outer_diameter_m: 0.168, inner_diameter_m: 0.095}"
    string = load_string(written(tmp_path, GOOD.replace(joints, "")))
    pipes = [Pipe(2500.0, 0.127, 0.1086, lumps=100), Pipe(200.0, 0.127, 0.0762, lumps=8),
             Pipe(150.0, 0.203, 0.0714, lumps=8)]
    a, _, _ = lumped_chain(pipes, 10.0, 20.0, stuck=stuck)
    chain, exact = chain_modes(a, 2.2), ClosedSystem(string, stuck=stuck).modes(2.2)
    assert len(chain) == len(exact) >= 3
    for (hertz, damping), mode in zip(chain, exact, strict=True):
        assert hertz == pytest.approx(mode.frequency_hz, rel=1e-3)
        assert damping == pytest.approx(mode.damping, abs=1e-3)


def test_cutting_a_section_changes_nothing():
    whole = STRING.lines[0]
    parts = tuple(WaveLine(length, whole.inertia_kg_m, whole.compliance_rad_nm_m, whole.drag_nm_s_rad_m)
                  for length in (700.0, 1.0, 2299.0))
    cut = DrillString(parts, STRING.bottom_inertia_kg_m2, STRING.bottom_viscous_nm_s_rad)
    s = np.array([0.1j, 3.0 + 2.0j, -1.0 + 12.0j, 1e-7])
    for one, other in zip(cut.at_top(s), STRING.at_top(s), strict=True):
        assert one == pytest.approx(other, rel=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(1.0, 4000.0), st.floats(0.08, 0.3), st.floats(0.0, 0.7), st.floats(0.0, 0.05)),
                min_size=1, max_size=4), st.floats(1.0, 5000.0), st.floats(0.0, 100.0))
def test_every_string_is_passive(sections, inertia, viscous):
    """The impedance Z_s is positive real: Re Z_s ≥ 0 in the right half-plane, and Z_s(s*) = Z_s(s)*."""
    lines = []
    for length, outer, bore, drag in sections:
        polar = pi / 32 * outer**4 * (1 - bore**4)
        lines.append(WaveLine(length, 7850 * polar, 1 / (79.3e9 * polar), drag))
    string = DrillString(tuple(lines), inertia, viscous)
    s = np.array([0.01 + 0.3j, 0.2 + 2.0j, 0.001 + 7.0j, 1.0, 0.5 + 30.0j])
    seen = string.impedance_at(s)
    assert np.all(seen.real >= -1e-9 * np.abs(seen))
    assert np.conj(string.impedance_at(np.conj(s))) == pytest.approx(seen)


def test_an_identified_spring_and_mass_have_the_identified_frequency():
    string = spring_and_mass(314.0, 0.1299)
    assert string.stiffness_nm_rad == pytest.approx(314.0)
    first, second, *_ = string_modes_hz(string)
    assert first == pytest.approx(0.1299, rel=1e-4)
    assert second > 8.0 * first        # mode of the spring itself, far above the identified one
    assert string.inertia_kg_m2 == pytest.approx(314.0 / (2 * pi * 0.1299) ** 2, rel=0.08)
    damped = spring_and_mass(314.0, 0.1299, 40.0)
    mode, *_ = ClosedSystem(damped).modes(0.2)
    assert mode.damping == pytest.approx(40.0 * 2 * pi * 0.1299 / (2 * 314.0), rel=0.03)     # c ω/2k
    (mode,) = ClosedSystem(string).modes(0.2)
    assert mode.damping == pytest.approx(0.010, abs=0.001)


def drawn(**tolerance):
    """Return 200 strings of pipe on a deviated wall above collars, drawn with these tolerances and no others."""
    none = {"length": 0.0, "shear_modulus": 0.0, "wear": 0.0, "outer_diameter": 0.0, "inner_diameter": 0.0,
            "drag": 0.0, "wall_friction": 0.0, "bottom_inertia": 0.0}
    pipe = PipeSection(length_m=2800.0, side_force_n_m=100.0, **FIVE_INCH)
    collars = PipeSection(length_m=200.0, outer_diameter_m=0.2032, inner_diameter_m=0.0714)
    string = string_of(StringFile(sections=(pipe,), bottom=BottomEnd(sections=(collars,)),
                                  tolerance=ToleranceFile(**{**none, **tolerance})))
    found = draw_truths(string, TopDrive(1500.0, 8.0, 60.0, (0.01,)), Interval(1500.0, 1500.0, 1500.0), count=200)
    lines = [[getattr(one.string.lines[k], name) / getattr(string.lines[k], name)
              for k, name in ((0, "inertia_kg_m"), (1, "inertia_kg_m"), (0, "static_nm_m"))] for one in found]
    return np.array(lines).T


def ratio(outer, inner):
    """Return the polar moment of area of 5 inch pipe with changed diameters, relative to the stated ones."""
    return ((0.127 * outer)**4 - (0.1086 * inner)**4) / (0.127**4 - 0.1086**4)


@pytest.mark.parametrize(("tolerance", "moved", "low", "high"), [
    ({"outer_diameter": 0.0075}, 0, ratio(0.9925, 1.0), ratio(1.0075, 1.0)),
    ({"inner_diameter": 0.0075}, 0, ratio(1.0, 1.0075), ratio(1.0, 0.9925)),
    ({"wear": 0.15}, 0, 0.85, 1.0),
    ({"bottom_inertia": 0.1}, 1, 0.9, 1.1),
    ({"wall_friction": 0.5}, 2, 1.0 / 1.5, 1.5),
])
def test_diameters_collars_and_wall_friction_are_drawn_over_their_tolerances(tolerance, moved, low, high):
    """Each tolerance varies its own property over its whole range, and no other one."""
    found = drawn(**tolerance)
    assert low <= found[moved].min() < low + 0.02 * (high - low) and high - 0.02 * (high - low) < found[moved].max()
    assert found[moved].max() <= high
    assert np.delete(found, moved, axis=0) == pytest.approx(1.0, abs=1e-12)


def test_measured_diameters_contain_the_wear():
    def polar(**tolerance):
        section = PipeSection(length_m=1000.0, **FIVE_INCH)
        return string_of(StringFile(sections=(section,), bottom=BottomEnd(inertia_kg_m2=100.0),
                                    tolerance=ToleranceFile(**tolerance))).tolerance.polar

    assert polar() == pytest.approx((0.85, 1.0))
    assert polar(outer_diameter=0.001) == (1.0, 1.0)
    assert polar(outer_diameter=0.001, wear=0.05) == pytest.approx((0.95, 1.0))
