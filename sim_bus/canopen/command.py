"""The command ``simulate canopen``: its options and its execution."""

import argparse
import contextlib
import socket
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sim_bus.command_arguments import (
    Unusable,
    add_drive_arguments,
    host_and_port,
    never_came,
    number_from,
    ready,
    rig_of,
    until_stopped,
)

if TYPE_CHECKING:
    import can


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of a simulated CANopen drive, with python-can's bus options."""
    from can.cli import add_bus_arguments

    add_bus_arguments(parser)
    group = parser.add_argument_group("simulated drive")
    group.add_argument("--hub", metavar="HOST:PORT", type=host_and_port,
                       help="open a socketcand hub at this address and connect the drive to it; port 0: any free port")
    group.add_argument("--node", metavar="N", type=number_from(1, 127, "a node ID"), default=1,
                       help="node ID, 1 to 127 (default 1)")
    add_drive_arguments(group, "heartbeat-lost@hold+2s", "each SYNC advances the rig by the period in 1006h")


def run(namespace: argparse.Namespace) -> int:
    """Simulate until SIGINT or SIGTERM. Print one line ``ready: …`` on stdout. Return the exit code."""
    from sim_bus.canopen.faults import listing

    def simulate(stop: threading.Event) -> None:
        from profiles import load_canopen_profile
        from sim_bus.canopen.faults import parse_all
        from sim_bus.canopen.simulator import Simulator

        faults = parse_all(namespace.fault)
        profile = load_canopen_profile(namespace.profile) if namespace.profile is not None else None
        params = rig_of(namespace)
        with _open_bus(namespace) as (bus, reached_by):
            simulator = Simulator(
                bus, params, node_id=namespace.node, seed=namespace.seed, trace=namespace.trace,
                stepped=namespace.stepped, profile=profile, faults=faults,
            )
            worn = f" profile {profile.name}" if profile is not None else ""
            ready(f"{reached_by} node {namespace.node}{worn}")
            simulator.run(stop)
            never_came(simulator.faults_waiting)

    return until_stopped(namespace, listing, simulate)


@contextlib.contextmanager
def _open_bus(namespace: argparse.Namespace) -> Iterator[tuple["can.BusABC", str]]:
    """Open the bus. Yield it with a text on how other programs reach it."""
    bus: can.BusABC
    if namespace.hub is not None:
        from sim_bus.canopen.socketcand import Hub, HubPort

        host, port = namespace.hub
        try:
            hub = Hub(host, port)
        except OSError as error:
            raise Unusable(f"can't open a hub at {host}:{port}: {error.strerror or error}") from error
        bus, reached_by = HubPort(hub), f"socketcand {hub.host}:{hub.port} channel {hub.channel}"
    else:
        bus, reached_by = _can_bus(namespace)
    try:
        yield bus, reached_by
    finally:
        bus.shutdown()


def _can_bus(namespace: argparse.Namespace) -> tuple["can.BusABC", str]:
    import can.util
    from can.cli import create_bus_from_namespace

    if not hasattr(namespace, "interface") and not hasattr(namespace, "channel"):
        try:                 # python-can finds an interface in its files or in CAN_* variables
            can.util.load_config()
        except can.CanInterfaceNotImplementedError:
            raise Unusable("no bus: give -i and -c, or --hub HOST:PORT, or configure python-can") from None
    given = dict(getattr(namespace, "bus_kwargs", None) or {})
    if getattr(namespace, "interface", None) == "socketcand" and {"host", "port"} <= given.keys():
        # Check the server first: python-can would try for ten seconds, at full load, to reach a missing server.
        host, port = str(given["host"]), int(given["port"])
        try:
            socket.create_connection((host, port), timeout=2.0).close()
        except OSError as error:
            raise Unusable(f"no socketcand server at {host}:{port}: {error.strerror or error}") from error
    try:
        bus = create_bus_from_namespace(namespace)
    except argparse.ArgumentError as error:
        raise Unusable(f"can't open the bus: {error.__cause__ or error}") from error
    return bus, bus.channel_info
