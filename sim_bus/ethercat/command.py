"""The command ``simulate ethercat``: its options and its execution."""

import argparse
import threading

from sim_bus.command_arguments import (
    Unusable,
    add_drive_arguments,
    never_came,
    number_from,
    ready,
    rig_of,
    until_stopped,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a simulated EtherCAT drive."""
    group = parser.add_argument_group("simulated drive", "A test tool and a simulator, not a product slave.")
    group.add_argument("-i", "--interface", metavar="NAME",
                       help="the Ethernet interface to answer on, such as one end of a veth pair (needs CAP_NET_RAW)")
    group.add_argument("--alias", metavar="N", type=number_from(0, 65535, "an alias"), default=0,
                       help="configured station alias, 0 to 65535 (default 0)")
    add_drive_arguments(group, "frame-loss@hold+2s=1%%",
                        "each exchange of process data advances the rig by the period in 5FFEh:3")


def run(namespace: argparse.Namespace) -> int:
    """Simulate until SIGINT or SIGTERM. Print one line ``ready: …`` on stdout. Return the exit code."""
    from sim_bus.ethercat.faults import listing, parse_all

    def simulate(stop: threading.Event) -> None:
        from profiles import load_ethercat_profile
        from sim_bus.ethercat.simulator import Simulator, raw_socket

        if namespace.interface is None:
            raise Unusable("no interface: give -i NAME")
        simulator = Simulator(rig_of(namespace), seed=namespace.seed, trace=namespace.trace, alias=namespace.alias,
                              stepped=namespace.stepped, faults=parse_all(namespace.fault),
                              profile=load_ethercat_profile(namespace.profile) if namespace.profile else None)
        with raw_socket(namespace.interface) as line:
            ready(f"{namespace.interface} position 0: a simulator for tests, not a product slave")
            simulator.run(line, stop)
            never_came(simulator.faults_waiting)

    return until_stopped(namespace, listing, simulate)
