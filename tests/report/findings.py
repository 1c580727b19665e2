"""Results made by hand, complete or with every part missing, and a recording for them."""

from dataclasses import replace

import numpy as np

from tdhil.estimation import (
    BudgetLine,
    Compliant,
    Estimate,
    FrictionPoint,
    Identification,
    InertiaEstimate,
    LineFit,
    PaperEstimate,
    ResidualTest,
    SecondOpinion,
    Verdict,
)
from tdhil.estimation.result import LinePoint
from tdhil.recording.recording import Excitation, Level, Segment, Stage
from tests.estimation.reporting import recorded

RUN = {
    "tdhil": "0.1.0", "started": "2026-03-04T05:06:07+01:00", "operator": "A. <Person>", "note": "after\x1b[31m repair",
    "rig_file": "rig.yaml", "drive": "canopen", "embedded_simulator": False,
    "bus": {"channel": {"value": "can0", "source": "-c"}, "bitrate": {"value": 500000, "source": "-b"}},
    "identity": {"vendor": 0x2A, "product": 402, "revision": 1, "serial": 987654, "name": "Drive \x1b]0;x"},
    "profile": {"name": "vendor/model", "title": "A drive"},
    "bench": {"name": "Hall B", "load": "string", "limits": {"torque_nm": 400.0, "speed_min_rad_s": 0.5,
                                                             "speed_max_rad_s": 10.0}},
}
"""Configuration of a run, with texts of a drive or a user."""


def around(value, half):
    return Estimate(value, value - half, value + half)


def full():
    """Return a valid result of a compliant shaft; one cross-check agrees, one does not."""
    points = ((2.9, 83.1, 1.5), (3.6, 88.8, 0.8), (5.5, 104.5, 2.8), (7.0, 116.2, 0.8))
    return Identification(
        verdict=Verdict.VALID,
        model="two-mass",
        reason="two masses explain the data (p = 0.77)",
        advice="identical filters on both signals would sharpen this",
        inertia=InertiaEstimate(104.0, 103.55, 104.45, 99.9, 108.1, 0.95, ("torque scale exact",)),
        viscous_nm_s_rad=around(8.06, 0.19),
        coulomb_nm=around(59.7, 1.0),
        speed_lag_s=around(0.407, 0.018),
        torque_lag_s=around(0.156, 0.027),
        skew_s=around(-0.00003, 0.015),
        paper=PaperEstimate(LineFit(111.5, 102.5, 0.94), LineFit(41.9, 98.0, 0.4)),
        residual=ResidualTest(9.0, 11.0, 0.77),
        periods_used=20,
        samples_used=50_000,
        warnings=("friction <b>bends</b> & more",),
        budget=(
            BudgetLine("noise", 0.31, "scatter from period to period"),
            BudgetLine("lags", 0.2, "of speed and torque, which J can't be told from altogether"),
            BudgetLine("torque scale", 4.1, "2 % (1 sd)"),
        ),
        second_opinions=(
            SecondOpinion("speed change", around(130.6, 2.3), True, "3 changes of speed", 0.29),
            SecondOpinion("coast-down", around(90.0, 3.0), False, "1 change of speed without torque"),
        ),
        friction_curve=tuple(FrictionPoint(speed, around(torque, half)) for speed, torque, half in points),
        compliant=Compliant(around(130.0, 2.0), around(26.0, 3.0), around(500.0, 20.0), None, around(0.9, 0.1), None),
        lines=tuple(
            LinePoint(hertz, around(seen, 0.6), seen + 0.2, around(-2.0, 0.5), -2.1, 0.5)
            for hertz, seen in ((0.1, 107.8), (0.2, 112.0), (0.3, 119.4), (0.4, 128.1))
        ),
    )


def bare():
    """Return a refusal with its reason only."""
    return Identification(
        verdict=Verdict.NOT_IDENTIFIABLE, reason="12 samples are no record", advice="record for longer")


def open_sided():
    """Return estimates whose intervals are open on one side or on both."""
    everything = full()
    return replace(
        everything, verdict=Verdict.VALID_WIDE, speed_lag_s=Estimate(0.4, 0.1, float("inf")),
        skew_s=Estimate(0.0, -float("inf"), float("inf")),
        compliant=replace(everything.compliant, total_inertia=None),
    )


def recording(samples=4000, **changes):
    time = np.arange(samples) * 0.01
    speed, torque = 3.0 + np.sin(time), 80.0 + 60.0 * np.cos(time)
    torque[10:12] = np.nan
    facts = {
        "excitation": Excitation("multisine", "torque", (Segment(8.0, 28.0, 10.0, 1, 3.0, (0.1,), (1.0,), (0.0,)),)),
        "levels": (Level(4.0, 7.0),),
        "stages": (Stage("speed", 0.0, 8.0, "ok"), Stage("hold", 8.0, 8.0, "skipped"),
                   Stage("acquire", 8.0, 40.0, "degraded", "9 of 3200 cycles without feedback")),
        "torque_limit_nm": 150.0,
        "torque_scale_rel_sd": 0.02,
        "simulated": True,
    } | changes
    return recorded(time, speed, torque, **facts)
