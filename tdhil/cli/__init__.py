"""The command line: `tdhil.cli.main` chooses a command; each puts the rooms together."""
