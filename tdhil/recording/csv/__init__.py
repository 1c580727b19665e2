"""A trace that a drive's own tool exported as CSV: its layout found, read with line numbers, made a Recording."""

from typing import TYPE_CHECKING

from profiles import lazy_face

if TYPE_CHECKING:
    from tdhil.recording.csv.layout import USUAL as USUAL, parse_columns as parse_columns
    from tdhil.recording.csv.reader import Bench as Bench, read_recording as read_recording
else:
    __getattr__, __dir__ = lazy_face(__name__)
