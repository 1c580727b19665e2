"""What can go wrong on a Modbus line, as leaves of the one error tree (`drivers.errors`).

::

    CommunicationLost
    ├── NoReply            nothing came in time
    ├── BadReply           CRC, length, unit, function or transaction id are not those of the request
    │   └── NoisyReply     a reply that the line has damaged: the same may be asked again at once
    └── LinkLost           connection reset or closed, port gone; stays so until a new link is opened
    ObjectRefused
    └── RegisterRefused    exception reply to a request before motion
    DriveFault
    └── CycleRefused       exception reply to a request of the cycle

Exception codes: Modbus Application Protocol V1.1b3, section 7.
"""

from drivers.errors import CommunicationLost, DriveFault, ObjectRefused

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE, BUSY = 1, 2, 3, 4, 6

EXCEPTION_NAMES = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge, still working on it",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target does not respond",
}

_STEPS = {
    1: "The drive doesn't know this function: take it out of cycle.functions in the profile",
    2: "Count addresses from 0 (a manual's 40001 is 0); check the profile's address and the drive's model",
    3: "The drive takes no such value or number of registers: check scale and limits in the profile",
    4: "The drive failed while it worked on this: look at its own panel for a fault",
    6: "The drive is busy: wait, is a commissioning tool connected? Then start anew",
    10: "Check the gateway's configuration and the unit number (--unit)",
    11: "Check the drive behind the gateway: power, address, baud rate",
}


class NoReply(CommunicationLost):
    """The time for a reply is over."""


class BadReply(CommunicationLost):
    """Something came, but no reply to this request that could be trusted."""


class NoisyReply(BadReply):
    """A reply to this request, damaged on its way; the drive has most probably acted."""


class LinkLost(CommunicationLost):
    """The line itself is gone: connection reset, closed by the drive, adapter unplugged."""


class RegisterRefused(ObjectRefused):
    """The drive answered with an exception; ``code`` is its number."""

    def __init__(self, code: int, where: str) -> None:
        super().__init__(f"the drive refused: {exception_text(code)}", where=where, next_step=_STEPS.get(code, ""))
        self.code = code


class CycleRefused(DriveFault):
    """The drive answered a request of the cycle with an exception; ``code`` is its number."""

    def __init__(self, code: int, where: str) -> None:
        super().__init__(
            f"the drive refused a request of the cycle: {exception_text(code)}",
            where=where,
            next_step=_STEPS.get(code, "Look at the drive's own panel"),
        )
        self.code = code


def exception_text(code: int) -> str:
    """Number and name of an exception code."""
    return f"exception {code}, {EXCEPTION_NAMES.get(code, 'of the manufacturer')}"
