"""`python -m tdhil`."""

from tdhil.cli.main import console

console()
