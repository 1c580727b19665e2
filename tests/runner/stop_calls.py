"""Requests of a stop to the fake drive, and the times of that stop."""

from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stop import SILENT_CYCLES, SILENT_S
from tests.runner.fake_drive import PERIOD_S

SILENT = max(SILENT_CYCLES, round(SILENT_S / PERIOD_S))
LAG_S = ControlAssumptions().largest_speed_lag_s


def asked(drive):
    """Return the requests to the drive, without the exchanges."""
    return [call for call in drive.calls if call != "exchange" and not call.startswith("enable")]
