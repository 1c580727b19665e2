"""Start of `tdhil` and of `python -m tdhil`. Ctrl-C is handled after as few imports as possible."""

import sys
from typing import NoReturn

from tdhil.numerics import prepare


def console() -> NoReturn:
    """Run the command. Ctrl-C during its import also ends it without a traceback."""
    prepare()
    try:
        from tdhil.cli.main import console as run
    except KeyboardInterrupt:
        sys.stderr.write("tdhil: interrupted\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    console()
