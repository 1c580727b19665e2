"""One setting for every property test: the same examples at every run. TDHIL_FUZZ=1 looks for new ones instead."""

import os

from hypothesis import settings

settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("fuzz", deadline=None, max_examples=1000)
settings.load_profile("fuzz" if os.environ.get("TDHIL_FUZZ") else "same")
