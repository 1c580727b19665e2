"""`tdhil fleet` in its own terminal with Ctrl-C: the whole foreground group receives the signal."""

import os
import pty
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

_SCRIPT = """
import functools, os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)        # a shell's `&` has what it starts ignore it
os.open(os.ttyname(0), os.O_RDWR)                  # its controlling terminal from now on
import tdhil.fleet
from tdhil.cli.main import main
from tests.fleet import poison
tdhil.fleet.run_fleet = functools.partial(tdhil.fleet.run_fleet, function=getattr(poison, sys.argv[1]))
sys.exit(main(["fleet", *sys.argv[2:]]))
"""


def fleet_with_ctrl_c(function, arguments, when):
    """Return the exit code. ``function``: one of `poison`. ``when``: called repeatedly; the first True sends Ctrl-C."""
    ours, theirs = pty.openpty()
    try:
        with subprocess.Popen([sys.executable, "-c", _SCRIPT, function, *arguments], stdin=theirs, stdout=theirs,
                              stderr=theirs, start_new_session=True, cwd=Path(__file__).parents[2]) as host:
            os.close(theirs)
            threading.Thread(target=_drained, args=(ours,), daemon=True).start()
            while host.poll() is None and not when():
                time.sleep(0.01)
            with suppress(OSError):
                os.write(ours, b"\x03")
            return host.wait()
    finally:
        os.close(ours)


def _drained(terminal):
    with suppress(OSError):
        while os.read(terminal, 4096):
            pass
