"""The field studies on a bench: sections 5.1 and 5.2 of the paper, figures 19 to 23."""

from __future__ import annotations

from tdhil.study.field import FieldBench
from tdhil.study.field_gains import KiSweep, KpSweep
from tdhil.study.field_loops import LoopScatter
from tdhil.study.field_slopes import FieldSlopes
from tdhil.study.field_tones import ToneSweep
from tdhil.study.outcome import Study


def field_studies(bench: FieldBench) -> tuple[Study, ...]:
    """In the paper's order."""
    return (LoopScatter(bench), KpSweep(bench), KiSweep(bench), FieldSlopes(bench), ToneSweep(bench))
