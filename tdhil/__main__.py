"""`python -m tdhil`."""

import sys

from tdhil.cli import main

sys.exit(main())
