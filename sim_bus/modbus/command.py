"""The command ``simulate modbus``: its options and its execution."""

import argparse
import threading

from sim_bus.command_arguments import (
    Unusable,
    add_fault_argument,
    add_rig_arguments,
    host_and_port,
    never_came,
    number_from,
    ready,
    rig_of,
    until_stopped,
)

DEFAULT_PROFILE = "generic/modbus"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a simulated Modbus drive."""
    parser.set_defaults(complain=parser.error)
    group = parser.add_argument_group("simulated drive")
    group.add_argument("--profile", metavar="NAME", default=DEFAULT_PROFILE,
                       help=f"profile of the simulated drive: a name, or a .yaml file (default {DEFAULT_PROFILE})")
    line = group.add_mutually_exclusive_group()
    line.add_argument("--tcp", metavar="HOST:PORT", type=host_and_port,
                      help="listen at this address; port 0: any free port; without a host: this computer only")
    line.add_argument("--rtu", metavar="DEVICE", nargs="?", const="",
                      help="listen on a serial device; without one on a pseudo terminal, named on the ready line")
    group.add_argument("--unit", metavar="N", type=number_from(1, 247, "a unit"),
                       help="unit, 1 to 247 (default: the profile's)")
    add_rig_arguments(group)
    group.add_argument("--wrong", metavar="NAME", action="append", default=[],
                       help="make the drive deviate from its profile: word_order, scale_10, address_off_by_one, sign, "
                       "unsigned, write_not_applied, reads_back_something_else:PARAMETER; repeatable")
    add_fault_argument(group, "no-reply@hold+2s")


def run(namespace: argparse.Namespace) -> int:
    """Simulate until SIGINT or SIGTERM. Print one line ``ready: …`` on stdout. Return the exit code."""
    from sim_bus.modbus.faults import listing

    def simulate(stop: threading.Event) -> None:
        from profiles import load_modbus_profile
        from sim_bus.modbus.faults import Faults, parse_all, wrongs_of
        from sim_bus.modbus.lines import RequestListener, RtuListener, TcpListener
        from sim_bus.modbus.machine import Machine
        from sim_bus.modbus.server import DriveServer
        from sim_bus.modbus.wrong_maps import parse

        if namespace.tcp is None and namespace.rtu is None:
            namespace.complain("one of the arguments --tcp --rtu is required")
        script = parse_all(namespace.fault, "rtu" if namespace.tcp is None else "tcp")
        params = rig_of(namespace)
        profile = load_modbus_profile(namespace.profile)
        line = profile.line
        names = [one.name for one in profile.parameters]
        wrongs = (*(parse(text, names) for text in namespace.wrong), *wrongs_of(script, names))
        unit = namespace.unit if namespace.unit is not None else line.unit
        if unit == 0:
            raise Unusable(f"{profile.name} leaves the factory without a unit number. Give --unit")
        with Machine(params, profile, seed=namespace.seed, trace=namespace.trace, wrongs=wrongs,
                     stepped=False) as machine:
            listener: RequestListener
            if namespace.tcp is not None:
                listener = TcpListener(*namespace.tcp)
            else:
                listener = RtuListener(namespace.rtu or None, baud=line.baud, parity=line.parity,
                                       stop_bits=line.stop_bits)
            faults = Faults(machine, profile, script, namespace.seed)
            try:
                server = DriveServer(machine, unit, listener, gateway=namespace.tcp is not None, faults=faults)
                ready(f"modbus {listener.reached_by} unit {unit} profile {profile.name}")
                server.run(stop)
                never_came(faults.waiting)
            finally:
                listener.close()

    return until_stopped(namespace, listing, simulate)
