"""Own network for the programs of one test: a Linux namespace with the loopback only.

A fixed port of a tutorial is therefore free, and other programs cannot reach it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator

_HOLD = """
import fcntl, socket, struct, sys
SIOCSIFFLAGS, IFF_UP = 0x8914, 1                    # linux/sockios.h, linux/if.h
with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
    fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", IFF_UP))
print("up", flush=True)
sys.stdin.read()
"""
"""Program that keeps the namespace, with its loopback up, until the test closes its input or ends."""


@contextlib.contextmanager
def own_network() -> Iterator[tuple[str, ...]]:
    """Yield the command prefix that runs a command in the new network; () if the system permits none.

    As root it is a network namespace. Another user needs a user namespace too, which some systems forbid.
    """
    root = sys.platform == "linux" and os.geteuid() == 0
    if sys.platform != "linux" or not (shutil.which("unshare") and shutil.which("nsenter")):
        yield ()
        return
    apart = ("unshare", "--net", *(() if root else ("--user", "--map-root-user")))
    holder = subprocess.Popen([*apart, sys.executable, "-c", _HOLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                              stderr=subprocess.DEVNULL, text=True)
    try:
        up = holder.stdout is not None and holder.stdout.readline() == "up\n"
        enter = ("nsenter", "--target", str(holder.pid), "--net",
                 *(() if root else ("--user", "--preserve-credentials")))
        yield enter if up else ()
    finally:
        holder.communicate()              # closes its input, and it ends
