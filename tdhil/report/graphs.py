"""Table of all graphs: the line below each one that states how to read it. docs/reference/graphs.md has a section for
each row, with a good and a bad example.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Graph:
    """How to read one graph. ``section``: heading on docs/reference/graphs.md. ``good``, ``bad``: what such a graph
    shows; ``bad`` ends with what to do.
    """

    section: str
    good: str
    bad: str

    @property
    def reading(self) -> str:
        """Line for the place below the graph."""
        return f"Good: {self.good}. Bad: {self.bad}."


GRAPHS = {
    "run": Graph(
        "Speed and torque",
        "all periods look alike, and the torque stays below its limit",
        "the torque is cut off (lower the amplitude), the speed comes near zero (raise the mean speed), or the periods "
        "drift (warm up)"),
    "live": Graph(
        "J during the run",
        "the interval becomes narrower, and each one overlaps the earlier ones",
        "J drifts or jumps (look for a change of the load or of the temperature)"),
    "estimates": Graph(
        "Estimates of the inertia",
        "the momentum cross-check overlaps the result; the acceleration regression may lie outside",
        "the cross-check does not overlap (compare the drive's filters and the load, and repeat the run)"),
    "lines": Graph(
        "Torque over acceleration at each excited frequency",
        "the curve passes through the points, and the residuals are about 1",
        "many residuals exceed 3 (check the stated lags), or the points rise steeply or change sign (look for a "
        "resonance)"),
    "response": Graph(
        "Frequency response",
        "the model passes through the points, and noise lies far below them",
        "distortion is detected (look for friction, backlash or a limit), or the model misses the points (check lags "
        "and resonances)"),
    "budget": Graph(
        "Uncertainty budget",
        "no bar is much longer than the accuracy that you need",
        "one bar is much longer than the others (reduce this source first)"),
    "friction": Graph(
        "Friction over speed",
        "the points lie on a straight line",
        "the points bend (stay above the bend, with a higher mean speed), or two points at one speed differ (warm up)"),
    "impedance": Graph(
        "The drive's own impedance",
        "the points lie on the curve, and the band of |r| is narrow",
        "the points scatter about the curve, or the band is wide (disconnect string and brake, or measure more "
        "periods)"),
    "open_loop": Graph(
        "Speed loop: open loop and sensitivity",
        "wherever |L| crosses 1, its phase is not between the dashed lines",
        "the phase is between the dashed lines where |L| crosses 1 (type in the tuned gains), or measured points "
        "lie off the curve (check the frequency response)"),
    "step": Graph(
        "Speed loop: step of the set speed",
        "the speed settles after one overshoot",
        "the speed oscillates for long (lower I), or the band is wide (state the lags inside the loop)"),
    "verified_step": Graph(
        "Speed loop: verified step",
        "the points lie on the dashed line",
        "the points follow the solid line away from it (other gains), or neither line (a ramp, a filter or another "
        "resonance)"),
    "reflection": Graph(
        "Soft torque: reflection at the top of the string",
        "|r| is small at the lowest mode of the string (dotted)",
        "|r| is near 1 there (a stiff controller: type in the soft gains)"),
    "modes": Graph(
        "Soft torque: modes and their damping",
        "the points below the second mode of the string are well damped",
        "one of these points is near 0, or any point is below 0 (change --a, or compensate less)"),
    "stick_slip": Graph(
        "Soft torque: stick-slip, with and without",
        "the bit comes free and turns steadily after a few oscillations",
        "the bit stops again and again (raise the set speed, or type in the soft gains)"),
    "map": Graph(
        "Soft torque: operator's map",
        "the usual set speed and bit torque lie in green",
        "they lie in yellow or red (raise the set speed, or lower the weight on bit)"),
    "schedule": Graph(
        "Soft torque: gains over depth",
        "the curves are smooth, and the crosses lie on them",
        "a cross lies off its curve, or a depth is missing (use a smaller step of depth, and read the sentence above)"),
    "string_close": Graph(
        "Evaluation on a virtual string",
        "the bit keeps turning, and its oscillation decays",
        "the bit stops again and again (the set speed is below the critical speed), or the oscillation does not decay "
        "(compare the gains)"),
    "string_course": Graph(
        "Evaluation on a virtual string",
        "the bit turns in all trials above the critical speed",
        "it sticks above that speed (compare the gains), or the torque is cut off (raise limits.torque_nm)"),
    "bit_speed": Graph(
        "Severity: speed at the bit",
        "the bit follows the top drive with a small oscillation",
        "the bit stops in each period (raise the set speed, lower the weight on bit, or tune soft torque)"),
    "severity": Graph(
        "Severity: index over the record",
        "the index stays below the lower line",
        "the index lies above the upper, red line (raise the set speed, lower the weight on bit, or tune soft torque)"),
    "bodies": Graph(
        "Calibration: bodies",
        "the line passes through the error bars of all runs",
        "a run lies off the line (check the inertia of this body and its bolts)"),
    "pairs": Graph(
        "Calibration: pairs of torque",
        "the residuals scatter about 0, and both directions agree",
        "rising and falling torque lie apart (hysteresis: look for friction between both sensors), or the residuals "
        "bend (use a smaller range)"),
    "sensor": Graph(
        "Calibration: record of a reference sensor",
        "the curves differ by the scale only, and the residuals look like noise",
        "the residuals drift or look like the motion (check the clock, the column and the place of the sensor)"),
    "linearity": Graph(
        "Calibration: linearity",
        "the residuals lie in a level band about 0",
        "the band has a slope, a curve or a kink (the scale changes with the torque: calibrate in the range of use)"),
    "trend": Graph(
        "Trend of a rig",
        "the points scatter about a constant value, within their intervals",
        "the points have a step or a drift (look for a change on the machine at that date)"),
    "compare": Graph(
        "Comparison of runs",
        "the points of all runs coincide",
        "they differ at high frequencies only (the drive's filters changed), or everywhere (the inertia changed)"),
    "friction_compare": Graph(
        "Comparison of runs",
        "the points of all runs coincide",
        "they differ at all speeds (compare temperature, brake, bearings and seals), or more at high speed (compare "
        "lubricant and fan)"),
}
"""Name of a graph, as in the code → how to read it."""
