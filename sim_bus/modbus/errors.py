"""How the drive refuses a request: a Modbus exception reply (Modbus application protocol, section 7)."""


class Refused(Exception):
    """The request is answered by an exception of this code."""

    code = 4


class IllegalFunction(Refused):
    """01: the drive doesn't know the function."""

    code = 1


class IllegalAddress(Refused):
    """02: no such register, or not to be written."""

    code = 2


class IllegalValue(Refused):
    """03: a count or a value that can't be."""

    code = 3


class DeviceFailure(Refused):
    """04: understood, and can't be done now."""

    code = 4
