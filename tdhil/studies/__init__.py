"""The paper's simulated and field experiments, and tdhil's own, as commands: published figures beside those of
tdhil.
"""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.studies.coverage import COVERAGE as COVERAGE
    from tdhil.studies.field import FieldRun as FieldRun, RunProgress as RunProgress, field_studies as field_studies
    from tdhil.studies.output import (
        Chapter as Chapter, INSTALL as INSTALL, StudyBar as StudyBar, document as document,
        print_list as print_list, print_outcome as print_outcome, tally as tally, write_report as write_report,
        write_study as write_study,
    )
    from tdhil.studies.registry import simulated_studies as simulated_studies
    from tdhil.studies.soft_torque import SOFT_TORQUE as SOFT_TORQUE
    from tdhil.studies.settings_files import load_study_file as load_study_file, with_assignments as with_assignments
    from tdhil.studies.study import Study as Study, StudyOutcome as StudyOutcome
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "coverage": "COVERAGE",
        "field": "FieldRun RunProgress field_studies",
        "output": "Chapter INSTALL StudyBar document print_list print_outcome tally write_report write_study",
        "registry": "simulated_studies",
        "soft_torque": "SOFT_TORQUE",
        "settings_files": "load_study_file with_assignments",
        "study": "Study StudyOutcome",
    })
