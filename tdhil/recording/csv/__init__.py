"""A trace that a drive's own tool exported as CSV: its layout found, read with line numbers, made a Recording."""
