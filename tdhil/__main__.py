"""`python -m tdhil`."""

import sys

from tdhil.cli.main import main

sys.exit(main())
