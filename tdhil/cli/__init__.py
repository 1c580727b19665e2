"""Command line: `tdhil.cli.main` selects a command, and each command combines the rooms that it needs."""
