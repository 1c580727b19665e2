"""The paper's simulated experiments: tables, figures and sweeps beside the published values."""

from tdhil.studies.paper.figures import (
    EffectStudy as EffectStudy, ScatterStudy as ScatterStudy, SignalStudy as SignalStudy,
)
from tdhil.studies.paper.loop import SYMBOLS as SYMBOLS, full_name as full_name
from tdhil.studies.paper.sweep_statements import (
    figure10 as figure10, figure12 as figure12, figure13 as figure13, figure9 as figure9,
)
from tdhil.studies.paper.sweeps import (
    FrequencySweep as FrequencySweep, InertiaSweep as InertiaSweep, KiSweepSettings as KiSweepSettings,
    KpSweepSettings as KpSweepSettings, SweepStudy as SweepStudy,
)
from tdhil.studies.paper.tables import (
    DesignStudy as DesignStudy, Table6Settings as Table6Settings, Table7Settings as Table7Settings,
)
