"""Identification of any record, periodic or not: the time domain's route."""

from tdhil.estimation.time_domain.identify import identify_record as identify_record, recorded as recorded
