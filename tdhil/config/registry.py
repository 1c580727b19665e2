"""What there is to choose from, each in one list: excitations, models of the shaft, buses.

The command line's choices, rig.yaml's schema, `tdhil.api` and the code that acts read these. An entry is a name, where
the object behind it stands and a line for people; the object is imported when it is asked for, so that ``--help``
loads none of them. Plants of the simulator, which knows nothing of us, have their own list: `sim_bus.plant.kinds`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class RegistryEntry:
    """``at``: ``module:attribute`` of the object; ``text``: what it is.

    What a recording's excitation is to those who can't import it: ``periodic``, it has lines and whole periods;
    ``plateaus``, the speed rests at levels within a period, so that it is calm there, and flat without being cut off;
    ``before_echo``, it is for drill strings alone, and tells the inertia from the time before their echo.
    """

    at: str
    text: str
    periodic: bool = False
    plateaus: bool = False
    before_echo: bool = False


@dataclass(frozen=True)
class BusEntry(RegistryEntry):
    """``at``: what a run asks of the bus, a `tdhil.session.connection.BusKind`: its options, how a drive is opened.

    ``commands``: what scan, doctor and rig new do on it, a `tdhil.cli.scan_common.BusCommands`. Both stand in modules
    that load no library of the bus by themselves: ``--help`` shows the options of every bus.
    """

    commands: str = ""


EXCITATIONS: dict[str, RegistryEntry] = {
    "multisine": RegistryEntry("tdhil.runner.excitation.signals:MULTISINE", "several tones at once, of a low crest",
                               True),
    "sine": RegistryEntry("tdhil.runner.excitation.signals:SINE", "one tone (equation 8 of the paper)", True),
    "step": RegistryEntry("tdhil.runner.excitation.signals:STEP",
                          "a square wave of speed (equation 9 of the paper)", True, True),
    "prbs": RegistryEntry("tdhil.runner.excitation.signals:PRBS",
                          "pseudo-random torque, for a string whose pipe is known", periodic=True, before_echo=True),
    "pulses": RegistryEntry("tdhil.runner.excitation.pulses:PULSES", "torque pulses between steady speeds"),
    "coast-down": RegistryEntry("tdhil.runner.excitation.pulses:COAST_DOWN",
                        "without torque down, under power back up; never with a string"),
}
"""Excitations of stage 5; each a `tdhil.runner.excitation.ExcitationKind`."""

DEFAULT_EXCITATION = "multisine"

MODELS: dict[str, RegistryEntry] = {
    "auto": RegistryEntry("tdhil.estimation.frequency_domain.shafts:AUTO", "the simplest that fits"),
    "rigid": RegistryEntry("tdhil.estimation.frequency_domain.shafts:RIGID", "one inertia, with reporting lags"),
    "two-mass": RegistryEntry("tdhil.estimation.frequency_domain.shafts:TWO_MASS", "two masses on a spring"),
    "string": RegistryEntry("tdhil.estimation.frequency_domain.shafts:STRING", "a string with a mass at its end"),
    "paper": RegistryEntry("tdhil.estimation.frequency_domain.shafts:PAPER", "rigid, by the paper's method: no lags"),
}
"""What the shaft is taken for."""

BUSES: dict[str, BusEntry] = {
    "canopen": BusEntry("tdhil.session.buses.canopen:CANOPEN", "CANopen, CiA 402",
                        commands="tdhil.cli.buses.canopen:CANOPEN"),
    "modbus": BusEntry("tdhil.session.buses.modbus:MODBUS", "Modbus TCP or RTU",
                       commands="tdhil.cli.buses.modbus:MODBUS"),
}
"""How a drive is spoken to.

Two things of a bus stand elsewhere: the schema of its profiles, below all this, in the list of `profiles.library`; its
section of rig.yaml, a field of `tdhil.config.rig.Rig`.
"""

DEFAULT_BUS = "canopen"


def load(registry: Mapping[str, RegistryEntry], name: str) -> Any:
    """Import what stands behind a name. KeyError where there is none of that name."""
    return imported(registry[name].at)


def imported(at: str) -> Any:
    """The object at ``module:attribute``."""
    module, _, attribute = at.partition(":")
    return getattr(import_module(module), attribute)


def names(registry: Mapping[str, RegistryEntry], *, periodic: bool = False) -> list[str]:
    """What there is, in its order; of the excitations, the periodic ones alone where asked."""
    return [name for name, entry in registry.items() if entry.periodic or not periodic]


SPEED_UNIT_TOLERANCE = 0.1
"""Of one, that the ratio of the shaft's angle to the integral of its reported speed may differ by. Encoders, gears and
slip of sound rigs are within a few per cent; units that are wrong are off by 2, 4, 2π, 10, 60."""


def has_plateaus(excitation: str) -> bool:
    """Does the speed rest at levels within a period? Not of an excitation that nobody knows any more."""
    return excitation in EXCITATIONS and EXCITATIONS[excitation].plateaus


def told_before_echo(excitation: str) -> bool:
    """Is it for drill strings, whose echo is not looked at? Not of an excitation that nobody knows any more."""
    return excitation in EXCITATIONS and EXCITATIONS[excitation].before_echo
