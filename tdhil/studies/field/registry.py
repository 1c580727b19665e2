"""Registry of the field studies on a bench: sections 5.1 and 5.2 of the paper, figures 19 to 23."""

from __future__ import annotations

from tdhil.studies.field.bench import FieldBench
from tdhil.studies.field.gains import KiSweep, KpSweep
from tdhil.studies.field.loops import LoopScatter, ToneSweep
from tdhil.studies.field.slopes import FieldSlopes
from tdhil.studies.study import Study


def field_studies(bench: FieldBench) -> tuple[Study, ...]:
    """Return the field studies, in the paper's order."""
    return (LoopScatter(bench), KpSweep(bench), KiSweep(bench), FieldSlopes(bench), ToneSweep(bench))
