"""The simulated studies by name, in the paper's order."""

from __future__ import annotations

from tdhil.studies.paper import sweep_statements as claims
from tdhil.studies.paper.figures import EffectStudy, ScatterStudy, SignalStudy
from tdhil.studies.paper.sweeps import FrequencySweep, InertiaSweep, KiSweepSettings, KpSweepSettings, SweepStudy
from tdhil.studies.paper.tables import DesignStudy, Table6Settings, Table7Settings
from tdhil.studies.study import Study


def simulated_studies() -> tuple[Study, ...]:
    """All that need no bench."""
    return (
        DesignStudy("table6", "Table 6: L16 over the system parameters", Table6Settings),
        DesignStudy("table7", "Table 7: L9 over friction and noise", Table7Settings),
        SweepStudy("figure9", "Figure 9: inertia and response", InertiaSweep, claims.figure9),
        SweepStudy("figure10", "Figure 10: frequency and response", FrequencySweep, claims.figure10),
        SignalStudy(),
        SweepStudy("figure12", "Figure 12: P and response", KpSweepSettings, claims.figure12),
        SweepStudy("figure13", "Figure 13: I and response", KiSweepSettings, claims.figure13),
        ScatterStudy("figure14", "Figure 14: the runs of Table 6, fitted", Table6Settings),
        ScatterStudy("figure15", "Figure 15: the runs of Table 7, fitted", Table7Settings),
        EffectStudy("figure16", "Figure 16: main effects of the system parameters", Table6Settings, "table6"),
        EffectStudy("figure17", "Figure 17: main effects of friction and noise", Table7Settings, "table7"),
    )
