"""Registry of the simulated studies by name, in the paper's order."""

from __future__ import annotations

from tdhil.studies.paper import (
    DesignStudy,
    EffectStudy,
    FrequencySweep,
    InertiaSweep,
    KiSweepSettings,
    KpSweepSettings,
    ScatterStudy,
    SignalStudy,
    SweepStudy,
    Table6Settings,
    Table7Settings,
    figure9,
    figure10,
    figure12,
    figure13,
)
from tdhil.studies.study import Study


def simulated_studies() -> tuple[Study, ...]:
    """Return all studies that need no bench."""
    return (
        DesignStudy("table6", "Table 6: L16 over the system parameters", Table6Settings),
        DesignStudy("table7", "Table 7: L9 over friction and noise", Table7Settings),
        SweepStudy("figure9", "Figure 9: inertia and response", InertiaSweep, figure9),
        SweepStudy("figure10", "Figure 10: frequency and response", FrequencySweep, figure10),
        SignalStudy(),
        SweepStudy("figure12", "Figure 12: P and response", KpSweepSettings, figure12),
        SweepStudy("figure13", "Figure 13: I and response", KiSweepSettings, figure13),
        ScatterStudy("figure14", "Figure 14: the runs of Table 6, fitted", Table6Settings),
        ScatterStudy("figure15", "Figure 15: the runs of Table 7, fitted", Table7Settings),
        EffectStudy("figure16", "Figure 16: main effects of the system parameters", Table6Settings, "table6"),
        EffectStudy("figure17", "Figure 17: main effects of friction and noise", Table7Settings, "table7"),
    )
