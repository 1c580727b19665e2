"""The command ``simulate canopen``: its options, and running it (``python -m sim_bus``, ``tdhil simulate``)."""

import argparse
import contextlib
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from profiles.errors import TdhilError

if TYPE_CHECKING:
    import can

EXIT_OK = 0
EXIT_USAGE = 2


class _Unusable(Exception):
    """Something the user gave can't be used; the text is the line to print."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of a simulated CANopen drive; python-can's bus options among them."""
    from can.cli import add_bus_arguments

    add_bus_arguments(parser)
    group = parser.add_argument_group("simulated drive")
    group.add_argument("--hub", metavar="HOST:PORT", type=_host_and_port,
                       help="open a socketcand hub there and be on it; port 0 takes any free one")
    group.add_argument("--node", metavar="N", type=_node_id, default=1, help="node ID, 1 to 127 (default 1)")
    group.add_argument("--plant", metavar="FILE", type=Path, help="YAML with other parameters of the rig")
    group.add_argument("--seed", metavar="N", type=_seed, default=0, help="seed of all noise (default 0)")
    group.add_argument("--trace", metavar="FILE", type=Path, help="write what the true shaft does to this CSV file")
    group.add_argument("--stepped", action="store_true", help="plant time moves with SYNC, by the period of 1006h")


def run(namespace: argparse.Namespace) -> int:
    """Simulates until SIGINT or SIGTERM; prints one line ``ready: …`` on stdout. Returns the exit code."""
    from sim_bus.params import RigParams, load_rig
    from sim_bus.simulator import Simulator

    stop = threading.Event()
    try:
        params = load_rig(namespace.plant) if namespace.plant is not None else RigParams()
        with _signals(stop), _open_bus(namespace) as (bus, reached_by):
            simulator = Simulator(
                bus, params, node_id=namespace.node, seed=namespace.seed, trace=namespace.trace,
                stepped=namespace.stepped,
            )
            print(f"ready: {reached_by} node {namespace.node}", flush=True)  # noqa: T201
            simulator.run(stop)
    except (_Unusable, TdhilError, OSError) as error:
        print(f"simulate: {error}", file=sys.stderr)  # noqa: T201
        return EXIT_USAGE
    return EXIT_OK


def main(argv: list[str] | None = None) -> int:
    """``python -m sim_bus canopen …``."""
    parser = argparse.ArgumentParser(prog="python -m sim_bus", description="A simulated drive with a shaft on it.")
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="KIND")
    add_arguments(kinds.add_parser("canopen", help="a CiA 402 drive on a CAN bus"))
    return run(parser.parse_args(argv))


def _host_and_port(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r} is not HOST:PORT")
    return host.strip("[]") or "127.0.0.1", int(port)


def _node_id(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 127:
        raise argparse.ArgumentTypeError(f"{text!r} is not a node ID from 1 to 127")
    return int(text)


def _seed(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a seed: a whole number from 0")
    return int(text)


@contextlib.contextmanager
def _open_bus(namespace: argparse.Namespace) -> Iterator[tuple["can.BusABC", str]]:
    """The bus, and how others reach it."""
    bus, reached_by = _hub_bus(*namespace.hub) if namespace.hub is not None else _can_bus(namespace)
    try:
        yield bus, reached_by
    finally:
        bus.shutdown()


def _hub_bus(host: str, port: int) -> tuple["can.BusABC", str]:
    from sim_bus.hub import Hub
    from sim_bus.hub_port import HubPort

    try:
        hub = Hub(host, port)
    except OSError as error:
        raise _Unusable(f"can't open a hub at {host}:{port}: {error.strerror or error}") from error
    return HubPort(hub), f"socketcand {hub.host}:{hub.port} channel {hub.channel}"


def _can_bus(namespace: argparse.Namespace) -> tuple["can.BusABC", str]:
    from can.cli import create_bus_from_namespace

    if not hasattr(namespace, "interface") and not hasattr(namespace, "channel") and not _configured():
        raise _Unusable("no bus: give -i and -c, or --hub HOST:PORT, or configure python-can")
    given = dict(getattr(namespace, "bus_kwargs", None) or {})
    if getattr(namespace, "interface", None) == "socketcand" and {"host", "port"} <= given.keys():
        _probe(str(given["host"]), int(given["port"]))
    try:
        bus = create_bus_from_namespace(namespace)
    except argparse.ArgumentError as error:
        raise _Unusable(f"can't open the bus: {error.__cause__ or error}") from error
    return bus, bus.channel_info


def _configured() -> bool:
    """python-can finds an interface in its files or in CAN_* variables."""
    import can.util

    try:
        can.util.load_config()
    except can.CanInterfaceNotImplementedError:
        return False
    return True


def _probe(host: str, port: int) -> None:
    """python-can would try for ten seconds, at full load, to reach a server that isn't there."""
    try:
        socket.create_connection((host, port), timeout=2.0).close()
    except OSError as error:
        raise _Unusable(f"no socketcand server at {host}:{port}: {error.strerror or error}") from error


@contextlib.contextmanager
def _signals(stop: threading.Event) -> Iterator[None]:
    """SIGINT and SIGTERM end the simulation; in another thread than the main one they can't be caught."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)
