"""Identification of any record, periodic or not: the time domain's route."""

from tdhil.identify.record_route.identify_record import identify_record, recorded

__all__ = ["identify_record", "recorded"]
