"""Many logs: identified by a pool or a cluster into one table; compared; followed over time."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from tdhil.fleet.archive_mark import ANNOTATIONS_FILE as ANNOTATIONS_FILE, is_archived as is_archived
    from tdhil.fleet.change_detection import (
        Difference as Difference, History as History, Measured as Measured, difference as difference,
        history as history,
    )
    from tdhil.fleet.fleet import (
        FleetRequest as FleetRequest, FleetSummary as FleetSummary, Progress as Progress, find_logs as find_logs,
        run_fleet as run_fleet,
    )
    from tdhil.fleet.rows import (
        FleetRow as FleetRow, FleetSettings as FleetSettings, counted as counted, row_of as row_of,
    )
    from tdhil.fleet.table import load_duckdb as load_duckdb, read_table as read_table
    from tdhil.fleet.task import Done as Done, LogTask as LogTask, identify_log as identify_log
    from tdhil.fleet.trend import (
        Compared as Compared, compare_document as compare_document, identified as identified,
        rehearsals_left_out as rehearsals_left_out, trend_document as trend_document,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "change_detection": "Difference History Measured difference history",
        "archive_mark": "ANNOTATIONS_FILE is_archived",
        "fleet": "FleetRequest FleetSummary Progress find_logs run_fleet",
        "rows": "FleetRow FleetSettings counted row_of",
        "table": "load_duckdb read_table",
        "task": "Done LogTask identify_log",
        "trend": "Compared compare_document identified rehearsals_left_out trend_document",
    })
