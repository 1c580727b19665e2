"""The families of control and status words, by their names in a profile (``control.family``)."""

from sim_bus.modbus.control_words.base import Extra, Wiring, ControlWords
from sim_bus.modbus.control_words.cia402 import Cia402Words
from sim_bus.modbus.control_words.danfoss import DanfossWords
from sim_bus.modbus.control_words.delta import DeltaWords
from sim_bus.modbus.control_words.profidrive import AbbWords, ProfidriveWords
from sim_bus.modbus.control_words.yaskawa import YaskawaWords

FAMILIES: dict[str, type[ControlWords]] = {
    "cia402": Cia402Words,
    "profidrive": ProfidriveWords,
    "abb": AbbWords,
    "danfoss_fc": DanfossWords,
    "yaskawa": YaskawaWords,
    "delta": DeltaWords,
}

__all__ = ["FAMILIES", "ControlWords", "Extra", "Wiring"]
