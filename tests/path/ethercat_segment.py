"""Pair of virtual Ethernet interfaces for tests, or the reason for its absence."""

import contextlib
import itertools
import os
import socket
import subprocess
import sys

import pytest

from tests.path.path_runs import PLAIN, Peer, process

_NUMBERS = itertools.count()


def why_not():
    """Return why this system has no segment for tests, or an empty text."""
    try:
        import pysoem  # noqa: F401
    except ImportError:
        return "pysoem is not installed (pip install '.[ethercat]')"
    if not hasattr(socket, "AF_PACKET"):
        return "no raw sockets on this system"
    with contextlib.suppress(OSError, RuntimeError), pair():
        return ""
    return "no veth pair or no raw sockets here: they need root and the kernel's veth"


def segment():
    """Skip without a segment, or fail if TDHIL_REQUIRE_VETH forbids a skip. The fixture has module scope."""
    reason = why_not()
    if reason and os.environ.get("TDHIL_REQUIRE_VETH") == "1":
        pytest.fail(f"no run over EtherCAT was tried ({reason}); TDHIL_REQUIRE_VETH=1 forbids to skip", pytrace=False)
    if reason:
        pytest.skip(f"no run over EtherCAT was tried: {reason}")


@contextlib.contextmanager
def pair():
    """Yield the two ends."""
    ends = tuple(f"et{os.getpid()}{letter}{next(_NUMBERS)}" for letter in "hd")
    done = subprocess.run(["ip", "link", "add", ends[0], "type", "veth", "peer", "name", ends[1]],
                          capture_output=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stderr.decode())
    try:
        for end in ends:
            subprocess.run(["ip", "link", "set", end, "up"], check=True)
        socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x88A4)).close()
        yield ends
    finally:
        subprocess.run(["ip", "link", "del", ends[0]], check=False)


@contextlib.contextmanager
def simulated_drive(folder, *arguments):
    """Run `sim_bus ethercat` in its own process; yield the options for a host at the other end."""
    trace = folder / "shaft.csv"
    with pair() as (ours, theirs), process(
        sys.executable, *PLAIN, "ethercat", "-i", theirs, "--trace", trace, *arguments, stdout=subprocess.PIPE
    ) as child:
        ready = child.stdout.readline()
        assert ready.startswith("ready: "), ready
        yield Peer(trace, ("-i", ours, "--position", "0"), child)
