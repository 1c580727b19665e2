"""The one error of the log, below the root of the tree in `drivers.errors`."""

from drivers.errors import TdhilError


class LogError(TdhilError):
    """The log can't be written (disk full, no such folder) or can't be read (empty, not MCAP, not a run of ours)."""
