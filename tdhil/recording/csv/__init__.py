"""A trace that a drive's own tool exported as CSV: its layout found, read with line numbers, made a Recording."""

from tdhil.recording.csv.layout import USUAL as USUAL, parse_columns as parse_columns
from tdhil.recording.csv.reader import Bench as Bench, read_recording as read_recording
