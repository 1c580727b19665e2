"""The families of control and status words, by their names in a profile (`control.family`)."""

from sim_bus.modbus.families.base import Extra, Wiring, Words
from sim_bus.modbus.families.cia402 import Cia402Words
from sim_bus.modbus.families.danfoss import DanfossWords
from sim_bus.modbus.families.delta import DeltaWords
from sim_bus.modbus.families.profidrive import AbbWords, ProfidriveWords
from sim_bus.modbus.families.yaskawa import YaskawaWords

FAMILIES: dict[str, type[Words]] = {
    "cia402": Cia402Words,
    "profidrive": ProfidriveWords,
    "abb": AbbWords,
    "danfoss_fc": DanfossWords,
    "yaskawa": YaskawaWords,
    "delta": DeltaWords,
}

__all__ = ["FAMILIES", "Extra", "Wiring", "Words"]
