"""The paper's field experiments, run on the whole path: slopes, loops, gains and amplitudes."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.studies.field.bench import FieldRun as FieldRun, RunProgress as RunProgress
    from tdhil.studies.field.registry import field_studies as field_studies
    from tdhil.studies.field.tone import tidy as tidy
else:
    __getattr__, __dir__ = lazy_face(__name__)
