"""Lists of choices: excitations, models of the shaft, buses.

The command line, the schema of rig.yaml, `tdhil.api` and the code that uses the choices read these lists. An entry has
a name, the place of its object and a line of text. The object is imported at first use, so that ``--help`` loads none
of them. The simulator is independent of tdhil and has its own list of plants: `sim_bus.plant.kinds`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class RegistryEntry:
    """Entry. ``at``: ``module:attribute`` of the object; ``text``: its description.

    Properties of an excitation, for code that cannot import it. ``periodic``: it has spectral lines and whole periods.
    ``plateaus``: the speed is constant for a time within each period. Its noise is low there, and a flat stretch is not
    a sign of clipping. ``before_echo``: it is for drill strings only, and J follows from the time before their echo.
    """

    at: str
    text: str
    periodic: bool = False
    plateaus: bool = False
    before_echo: bool = False


@dataclass(frozen=True)
class BusEntry(RegistryEntry):
    """Entry of a bus. ``at``: a `tdhil.buses.Bus`, whose module must not import a library of the bus, because
    ``--help`` shows the options of every bus.

    ``loggers``: loggers of these libraries. tdhil reports their errors itself.
    """

    loggers: tuple[str, ...] = ()


EXCITATIONS: dict[str, RegistryEntry] = {
    "multisine": RegistryEntry("tdhil.runner.excitation.signals:MULTISINE",
                               "several tones at once, with a low crest factor", True),
    "sine": RegistryEntry("tdhil.runner.excitation.signals:SINE", "one tone (equation 8 of the paper)", True),
    "step": RegistryEntry("tdhil.runner.excitation.signals:STEP",
                          "a square wave of speed (equation 9 of the paper)", True, True),
    "prbs": RegistryEntry("tdhil.runner.excitation.signals:PRBS",
                          "pseudo-random torque, for a string whose pipe is known", periodic=True, before_echo=True),
    "pulses": RegistryEntry("tdhil.runner.excitation.pulses:PULSES", "torque pulses between steady speeds"),
    "coast-down": RegistryEntry("tdhil.runner.excitation.pulses:COAST_DOWN",
                        "coasting down without torque, then driven back up; never with a string"),
}
"""Excitations of stage 5. Each is a `tdhil.runner.excitation.ExcitationKind`."""

DEFAULT_EXCITATION = "multisine"

MODELS: dict[str, RegistryEntry] = {
    "auto": RegistryEntry("tdhil.estimation.frequency_domain.shafts:AUTO", "the simplest that fits"),
    "rigid": RegistryEntry("tdhil.estimation.frequency_domain.shafts:RIGID", "one inertia, with reporting lags"),
    "two-mass": RegistryEntry("tdhil.estimation.frequency_domain.shafts:TWO_MASS", "two masses on a spring"),
    "string": RegistryEntry("tdhil.estimation.frequency_domain.shafts:STRING", "a string with a mass at its end"),
    "paper": RegistryEntry("tdhil.estimation.frequency_domain.shafts:PAPER",
                           "rigid shaft without lags, as in the paper (Xu 2026)"),
}
"""Models of the shaft."""

BUSES: dict[str, BusEntry] = {
    "canopen": BusEntry("tdhil.buses.canopen:CANOPEN", "CANopen, CiA 402", loggers=("can", "canopen")),
    "modbus": BusEntry("tdhil.buses.modbus:MODBUS", "Modbus TCP or RTU"),
    "ethercat": BusEntry("tdhil.buses.ethercat:ETHERCAT", "EtherCAT, CiA 402 (CoE)"),
}
"""Buses of a drive. `profiles.library`, which does not depend on tdhil, lists the schema of each bus's profiles."""

DEFAULT_BUS = "canopen"


def load(registry: Mapping[str, RegistryEntry], name: str) -> Any:
    """Return the object of a name. Raises KeyError for an unknown name."""
    return imported(registry[name].at)


def imported(at: str) -> Any:
    """Return the object at ``module:attribute``."""
    module, _, attribute = at.partition(":")
    return getattr(import_module(module), attribute)


def names(registry: Mapping[str, RegistryEntry], *, periodic: bool = False) -> list[str]:
    """Return the names in their order; with ``periodic``, only the periodic excitations."""
    return [name for name, entry in registry.items() if entry.periodic or not periodic]


USUAL_STAGE_S = MappingProxyType({"setup": 10.0, "speed": 50.0, "torque": 15.0, "hold": 15.0, "acquire": 300.0})
"""Usual duration of each stage, s, for the displays. The plan of the run replaces them."""


SPEED_UNIT_TOLERANCE = 0.1
"""Accepted relative deviation of the shaft's angle from the integral of its reported speed. Encoders, gears and slip of
sound rigs stay within a few per cent. Wrong units give factors of 2, 4, 2π, 10 or 60."""


def has_plateaus(excitation: str) -> bool:
    """Return whether the speed is constant for a time within each period. False for an unknown excitation."""
    return excitation in EXCITATIONS and EXCITATIONS[excitation].plateaus


def identified_before_echo(excitation: str) -> bool:
    """Return whether J follows from the time before a string's echo. False for an unknown excitation."""
    return excitation in EXCITATIONS and EXCITATIONS[excitation].before_echo
