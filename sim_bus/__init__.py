"""Simulated drive and shaft: plant, inverter, and their interface on each bus."""

from typing import TYPE_CHECKING

from profiles import lazy_names

if TYPE_CHECKING:
    from sim_bus.command import add_kinds as add_kinds
    from sim_bus.command_arguments import printed_width as printed_width
    from sim_bus.fault_script import KnownFault as KnownFault, Scripted as Scripted
    from sim_bus.params import RigParams as RigParams
    from sim_bus.shaft_judge import (
        TURNING_RAD_S as TURNING_RAD_S, Judged as Judged, JudgedMachine as JudgedMachine,
        ProcessOutcome as ProcessOutcome, TrueShaft as TrueShaft, judge as judge, read_shaft as read_shaft,
    )
    from sim_bus.trace import check_trace_path as check_trace_path
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__, {
        "command": "add_kinds",
        "command_arguments": "printed_width",
        "fault_script": "KnownFault Scripted",
        "params": "RigParams",
        "shaft_judge": "TURNING_RAD_S Judged JudgedMachine ProcessOutcome TrueShaft judge read_shaft",
        "trace": "check_trace_path",
    })
