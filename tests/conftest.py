"""One setting for every property test: the same examples at every run. TDHIL_FUZZ=1 looks for new ones instead.

And Ctrl-C as usual: a shell that starts the tests in the background has it ignored, which every child would inherit.
"""

import os
import signal
import threading

from hypothesis import settings

settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("fuzz", deadline=None, max_examples=1000)
settings.load_profile("fuzz" if os.environ.get("TDHIL_FUZZ") else "same")

if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
