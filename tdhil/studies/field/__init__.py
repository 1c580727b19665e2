"""The paper's field experiments on the whole signal path: slopes, loops, gains and amplitudes."""

from tdhil.studies.field.bench import FieldRun as FieldRun, RunProgress as RunProgress
from tdhil.studies.field.registry import field_studies as field_studies
from tdhil.studies.field.tone import tidy as tidy
