"""Reading of a CSV trace from a drive's own tool: find its layout, read it with line numbers, return a Recording."""

from tdhil.recording.csv.excitation import motion_of as motion_of
from tdhil.recording.csv.layout import (
    REFERENCE_FLAG as REFERENCE_FLAG, TIME_AND_TORQUE as TIME_AND_TORQUE, USUAL as USUAL,
    parse_columns as parse_columns,
)
from tdhil.recording.csv.reader import (
    GAP_INTERVALS as GAP_INTERVALS, Bench as Bench, ReferenceTrace as ReferenceTrace,
    read_recording as read_recording, read_reference as read_reference,
)
from tdhil.recording.csv.survey import (
    TraceSurvey as TraceSurvey, column_mistakes as column_mistakes, survey_trace as survey_trace, units_of as units_of,
)
