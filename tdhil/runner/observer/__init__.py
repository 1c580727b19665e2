"""Observer: compares the drive's reports with each other in every cycle, and finds a report that contradicts the
others. Pure.

No report is trusted alone. The reports of speed, torque and angle belong to one shaft, so its momentum balance holds
between any two instants s and t:

    J (ω_t − ω_s) = ∫ (T − T_f) dt                        T_f: friction, or the torque of a drill string

The reports lag. For a first-order lag the true value is ω = z + τ_w dz/dt, and the true impulse is ∫T = ∫z_T + τ_T
Δz_T. With both time constants between zero and the longest plausible one, the imbalance of the reports must lie in an
interval:

    J Δz − ∫ (z_T − T_f) dt  ∈  τ_T ΔT − J τ_w Δα ± noise                                              (1)

Every quantity enters with its bounds: J and T_f from the run so far, the acceleration α from the slope of the reported
speed and from the torque, rounding and noise of the reports. (1) is tested over several windows. A report contradicts
the others if (1) fails for each J within its bounds, twice in a row. The bounds are worst cases, not standard
deviations, so false alarms come only from effects outside the bounds; `benchmarks/healthy_runs.py` counts them.

A second test needs no window. A reported speed is an average of true speeds with weights ≥ 0. Its slope therefore lies
between the least and the greatest acceleration that torque and load allow, for any lag:

    (T_min − T_f)/J_min  ≤  dz/dt  ≤  (T_max + T_f)/J_min                                              (2)

In torque mode T_min and T_max are those of the commanded and the reported torque. In speed mode they are those of the
reported torque, with a margin for its lag.

The position is compared with the integral of the reported speed, ∫ω dt = ∫z dt + τ_w Δz, as soon as stage 2 has
confirmed the unit of speed. In torque mode the mean reported torque is compared with the mean commanded torque.

The bounds improve during the run. Before the shaft has moved there are none. From the first ramp on there is an upper
bound of friction. From the end of stage 2 on, J and friction are known with their uncertainty. No observer can find a
torque scale that is wrong in every report, or a speed scale that is wrong from the start without a reported position,
because these contradict no other report.
"""

from tdhil.runner.observer.contradiction import Contradiction, Signal
from tdhil.runner.observer.observer import Observer
from tdhil.runner.observer.runaway import FASTER_SHARE
from tdhil.runner.observer.shaft_bounds import RUN_OUT_S
from tdhil.runner.observer.unanswered_torque import AT_LIMIT_SHARE

__all__ = ["AT_LIMIT_SHARE", "FASTER_SHARE", "RUN_OUT_S", "Contradiction", "Observer", "Signal"]
