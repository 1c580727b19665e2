"""CiA 402 words over Modbus (CiA 402-2; Schneider's CMD and ETA, Lenze's, our own generic map)."""

from sim_bus.modbus.control_words.base import ControlWords

_OF_THE_MODE = 0x3000


class Cia402Words(ControlWords):
    """Controlword and statusword as in `sim_bus.cia402`, whose power side uses them directly.

    Option codes are the standard's defaults: shutdown coasts, disable operation brakes down the ramp. The profile
    states whether the drive holds after a quick stop. Bits 4 to 6 (ramp generator of velocity mode) are ignored.
    """

    shutdown_option = 0
    disable_option = 1

    def obey(self, before: int, word: int) -> None:
        self.select(word)
        self.set_quick_stop()
        self.application.write_controlword(word)

    def status(self) -> int:
        """Return the word without bits 12 and 13: they belong to the profile modes, and in velocity mode they are 0."""
        return self.application.statusword() & ~_OF_THE_MODE
