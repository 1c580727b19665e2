"""The observer: compares the drive's reports with each other in every cycle, and finds the one that does not fit. Pure.

No report is believed alone. The reports of speed, torque and angle belong to one shaft, so its balance of momentum
holds between any two instants s and t:

    J (ω_t − ω_s) = ∫ (T − T_f) dt                        T_f: friction, or the torque of a drill string

What is reported lags. For a first-order lag the true value is ω = z + τ_w dz/dt, and the true impulse is
∫T = ∫z_T + τ_T Δz_T. With both time constants anywhere between zero and the longest plausible one, the imbalance of the
reports must lie in an interval:

    J Δz − ∫ (z_T − T_f) dt  ∈  τ_T ΔT − J τ_w Δα ± noise                                              (1)

Every quantity enters with its bounds: J and T_f as known so far, the acceleration α from the slope of the reported
speed and from the torque, rounding and noise of the reports. (1) is tested over several windows. A report contradicts
the others if (1) fails for each J within its bounds, twice in a row. The bounds are worst cases and not standard
deviations, so the rate of false alarms is set by what the bounds leave out; `benchmarks/healthy_runs.py` counts it.

A second test needs no window. A reported speed is an average of true speeds with weights that are not negative, so its
slope lies between the least and the greatest acceleration that torque and load allow, whatever the lag:

    (T_min − T_f)/J_min  ≤  dz/dt  ≤  (T_max + T_f)/J_min                                              (2)

In torque mode T_min and T_max are those of the commanded and the reported torque, in speed mode those of the reported
torque with a margin for what its lag hides.

The position is compared with the way by the reported speed: ∫ω dt = ∫z dt + τ_w Δz, from the moment on at which
stage 2 has confirmed the unit of speed. In torque mode the mean reported torque is compared with the mean commanded
torque.

What the observer knows grows with the run. Before the shaft has moved it knows nothing. From the first ramp on it knows
how large friction can be at most. From the end of stage 2 it knows J and friction with their uncertainty. A torque
scale that is wrong in every report, and a speed scale that is wrong from the start where no position is reported,
contradict nothing: no observer can find them.
"""

from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.observer import Observer
from tdhil.runner.observer.shaft_bounds import RUN_OUT_S
from tdhil.runner.observer.unanswered_torque import AT_LIMIT_SHARE

__all__ = ["AT_LIMIT_SHARE", "RUN_OUT_S", "Contradiction", "Observer", "Signal"]
