"""Spectral lines above a drill string whose true dimensions are drawn from the tolerances of string.yaml.

The impedance of the string is that of the telegraph equation (`tests.estimation.compliant_bench`). The module uses no
code of the estimation.
"""

import numpy as np

from tdhil.calibration import calibrate_known_pipe
from tdhil.estimation import Refused, measure_lines
from tdhil.recording import Pipe as PipePrior
from tdhil.session import known_pipe_of
from tdhil.soft_torque import StringFile
from tests.estimation.compliant_bench import Pipe
from tests.estimation.test_two_mass import synthetic

SECTION = {"length_m": 2300.0, "outer_diameter_m": 0.127, "inner_diameter_m": 0.1086}
MEASURED = {"outer_diameter": 0.002, "inner_diameter": 0.002, "length": 0.005, "density": 0.005}
"""Tolerances of a pipe that was measured."""
LINES = (0.05, 0.08, 0.13, 0.2, 0.27, 0.35, 0.45, 0.55, 0.67, 0.8)


def string_file(tolerance):
    return StringFile.model_validate(
        {"sections": (SECTION,), "bottom": {"inertia_kg_m2": 374.0}, "tolerance": tolerance})


def true_pipe(rng, tolerance):
    """Return (inertia, stiffness) of a pipe within the tolerances; without them worn by up to 15 %, G 61 to 80 GPa."""
    def factor(name, default=0.0):
        half = tolerance.get(name, default)
        return rng.uniform(1.0 - half, 1.0 + half)

    outer, inner = 0.127 * factor("outer_diameter"), 0.1086 * factor("inner_diameter")
    polar = np.pi / 32.0 * (outer**4 - inner**4)
    if "outer_diameter" not in tolerance:
        polar *= rng.uniform(1.0 - tolerance.get("wear", 0.15), 1.0)
    shear, density, length = rng.uniform(61e9, 80e9), 7850.0 * factor("density", 0.005), 2300.0 * factor("length", 0.01)
    return density * polar * length, shear * polar / length


def study_case(seed, tolerance=None):
    """Return (relative error of κ, fit, whether it covers) of one string, or the reason of a refusal."""
    tolerance = MEASURED if tolerance is None else tolerance
    rng = np.random.default_rng([2803, seed])
    inertia, stiffness = true_pipe(rng, tolerance)
    factor = rng.uniform(0.95, 1.05)
    plant = Pipe(motor=rng.uniform(800.0, 2500.0), end=rng.uniform(200.0, 600.0), inertia=inertia, stiffness=stiffness)
    reported = Pipe(plant.motor / factor, plant.end / factor, inertia / factor, stiffness / factor, plant.drag / factor,
                    plant.motor_viscous / factor, plant.end_viscous / factor)
    lines, constraint = synthetic(reported, seed, rng.uniform(1.0, 4.0), LINES,
                                  lags=(rng.uniform(0.0, 0.5), rng.uniform(0.0, 0.3)))
    known = known_pipe_of(string_file(tolerance), 1.0)
    pipe = PipePrior(known.impedance_nm_s_rad * known.delay_s, known.impedance_nm_s_rad / known.delay_s, 1.0)
    try:
        measured = measure_lines(lines, constraint, (), {}, pipe, known.delay_rel_sd, known.exponent)
    except Refused as refused:
        return str(refused)
    fit = calibrate_known_pipe(known, measured)
    return fit.factor.value / factor - 1.0, fit, bool(fit.factor.low <= factor <= fit.factor.high)
