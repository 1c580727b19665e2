"""Power drive state machine of CiA 402, typed again from the standard, as the reference for the driver.

The numbers are the transitions of CiA 402-2. One controlword causes at most one transition.
"""

NOT_READY, OFF, READY, ON, ENABLED, STOPPING, REACTION, FAULT = (
    "not ready", "switch on disabled", "ready to switch on", "switched on", "operation enabled", "quick stop active",
    "fault reaction active", "fault",
)

# Patterns of the standard's table, such as xxxx xxxx x0xx 0000: mask and values of the bits.
STATUS_PATTERNS = {
    NOT_READY: "x0xx0000",
    OFF: "x1xx0000",
    READY: "x01x0001",
    ON: "x01x0011",
    ENABLED: "x01x0111",
    STOPPING: "x00x0111",
    REACTION: "x0xx1111",
    FAULT: "x0xx1000",
}

_SHUTDOWN, _SWITCH_ON, _ENABLE = "shutdown", "switch on", "enable"
_QUICK_STOP, _VOLTAGE_OFF = "quick stop", "voltage off"
_TRANSITIONS = {
    (OFF, _SHUTDOWN): READY,           # 2
    (READY, _SWITCH_ON): ON,           # 3
    (ON, _ENABLE): ENABLED,            # 4
    (ENABLED, _SWITCH_ON): ON,         # 5
    (ON, _SHUTDOWN): READY,            # 6
    (READY, _VOLTAGE_OFF): OFF,        # 7
    (READY, _QUICK_STOP): OFF,         # 7
    (ENABLED, _SHUTDOWN): READY,       # 8
    (ENABLED, _VOLTAGE_OFF): OFF,      # 9
    (ON, _VOLTAGE_OFF): OFF,           # 10
    (ON, _QUICK_STOP): OFF,            # 10
    (ENABLED, _QUICK_STOP): STOPPING,  # 11
    (STOPPING, _VOLTAGE_OFF): OFF,     # 12
    (STOPPING, _ENABLE): ENABLED,      # 16
}


def matches(low_byte: int, pattern: str) -> bool:
    """Return whether the low byte of a statusword fits a pattern such as x01x0111, bit 7 first."""
    return all(want in ("x", have) for want, have in zip(pattern, f"{low_byte:08b}", strict=True))


def command_of(word: int) -> str:
    """Bits 3 2 1 0 of a controlword: xx0x, x01x, x110, 0111, 1111."""
    bits = f"{word & 15:04b}"
    if bits[2] == "0":
        return _VOLTAGE_OFF
    if bits[1] == "0":
        return _QUICK_STOP
    if bits[3] == "0":
        return _SHUTDOWN
    return _ENABLE if bits[0] == "1" else _SWITCH_ON


class PowerMachine:
    """State of a drive. `step` makes its own transitions in a cycle, `obey` those of a controlword."""

    def __init__(self, state: str = OFF) -> None:
        self.state = state
        self.word = 0

    def step(self) -> None:
        self.state = {NOT_READY: OFF, REACTION: FAULT}.get(self.state, self.state)      # 1, 14

    def obey(self, word: int) -> None:
        rising = word & ~self.word & 0x80
        self.word = word
        if self.state == FAULT:
            if rising:
                self.state = OFF                                                          # 15
            return
        self.state = _TRANSITIONS.get((self.state, command_of(word)), self.state)

    def fail(self) -> None:
        """13"""
        self.state = REACTION

    @property
    def status(self) -> int:
        """Return the statusword with all undefined bits set: a test for equality instead of a mask fails."""
        return int(STATUS_PATTERNS[self.state].replace("x", "1"), 2) & ~0x80
