"""NMT, slave side (CiA 301): states as a heartbeat shows them, and the master's commands."""

from enum import IntEnum


class NmtState(IntEnum):
    """The byte of a heartbeat; 0 is the boot-up message."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """The first byte of a frame with identifier 0."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class Nmt:
    """The state, and what a command makes of it."""

    def __init__(self) -> None:
        self.state = NmtState.INITIALISING

    def obey(self, code: int) -> NmtCommand | None:
        """Takes a command; None where there is no such one. After a reset the node itself goes on from initialising."""
        try:
            command = NmtCommand(code)
        except ValueError:
            return None
        self.state = {
            NmtCommand.START: NmtState.OPERATIONAL,
            NmtCommand.STOP: NmtState.STOPPED,
            NmtCommand.ENTER_PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
        }.get(command, NmtState.INITIALISING)
        return command
