"""Version of tdhil."""

__version__ = "0.1.0"
