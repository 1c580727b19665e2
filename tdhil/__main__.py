"""`tdhil` in a shell, and `python -m tdhil`: as little as can be before Ctrl-C is understood."""

import sys
from typing import NoReturn

from tdhil.numerics import prepare


def console() -> NoReturn:
    """Run the command. Ctrl-C while it is still being imported ends it without a traceback, too."""
    prepare()
    try:
        from tdhil.cli.main import console as run
    except KeyboardInterrupt:
        sys.stderr.write("tdhil: interrupted\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    console()
