"""Why a serial device could not be opened, and the exact command that mends it."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from drivers.errors import PreflightRefused

_CANDIDATES = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyS[0-3]")


def refusal(device: str, error: OSError | ValueError) -> PreflightRefused:
    """What pyserial raised, as an error with a next step."""
    code = getattr(error, "errno", None)
    if code is None and error.__context__ is not None and error.__context__.args:
        code = error.__context__.args[0]        # termios.error, which pyserial wraps without its number
    if code == errno.ENOENT:
        what, step = "there is no such device", f"Plug the adapter in. {_there()}"
    elif code in (errno.EACCES, errno.EPERM):
        what, step = "permission denied", permission_command(device)
    elif code in (errno.EBUSY, errno.EAGAIN):
        what, step = "another program has it open", f"End that program; it is shown by: fuser {device}"
    elif code in (errno.ENOTTY, errno.EISDIR):
        what, step = "it is no serial device", _there()
    else:
        what, step = str(error), "Check device, baud rate and parity"
    return PreflightRefused(f"can't open the serial line: {what}", where=device, next_step=step)


def permission_command(device: str) -> str:
    """The command that gives this user the device's own group."""
    group = "dialout"
    try:
        import grp

        group = grp.getgrgid(Path(device).stat().st_gid).gr_name
    except (ImportError, OSError, KeyError):
        pass
    if group == "root":
        return f"Only root may use it; for now: sudo chmod a+rw {device}"
    return f"sudo usermod -a -G {group} {os.environ.get('USER', '$USER')}, then log out and in again"


def _there() -> str:
    found = sorted(str(path) for pattern in _CANDIDATES for path in Path("/dev").glob(pattern))
    return f"These are there: {', '.join(found)}" if found else "No serial device is there at all"
