"""CiA 402 words over Modbus (CiA 402-2; Schneider's CMD and ETA, Lenze's, our own generic map)."""

from sim_bus.modbus.control_words.base import ControlWords

_OF_THE_MODE = 0x3000


class Cia402Words(ControlWords):
    """Controlword and statusword as in `sim_bus.cia402`; the power side speaks them by itself.

    Option codes are the standard's defaults: shutdown coasts, disabling operation goes down the ramp. Whether the drive
    holds after a quick stop is the profile's. Bits 4 to 6 (ramp generator of velocity mode) are not looked at.
    """

    shutdown_option = 0
    disable_option = 1

    def obey(self, before: int, word: int) -> None:
        self.select(word)
        self.set_quick_stop()
        self.application.write_controlword(word)

    def status(self) -> int:
        """Without bits 12 and 13: what they mean belongs to the profile modes, and velocity mode leaves them at 0."""
        return self.application.statusword() & ~_OF_THE_MODE
