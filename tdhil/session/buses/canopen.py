"""CANopen: its options, and a drive on an open bus, or the embedded simulator on a virtual one."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from profiles import Profile
from profiles.canopen import CanopenProfile
from profiles.quantities import BIT_RATE, read
from tdhil.config import DriveData, Rig, RunOptions
from tdhil.session.buses import can_bus
from tdhil.session.buses.can_bus import BusConfig, bus_config
from tdhil.session.connection import BusKind, Connection, one_host

if TYPE_CHECKING:
    import can

    from drivers import Clock, Drive, FrameTap, Target
    from sim_bus import KnownFault
    from sim_bus.canopen import Simulator
    from tdhil.session.connection import PeerPlan

PLAIN = "generic/cia402"
"""Profile of the simulator if none is named."""
_ADAPTER = ("host", "port", "serial", "unique_hardware_id", "app_name")     # they identify the adapter


_OPTIONS: Final = {
    "channel": ("NAME", "channel of the adapter, such as can0"),
    "interface": ("NAME", "kind of adapter, such as socketcan, pcan or vector"),
    "bitrate": ("BIT_S", "bit rate, such as 500000 or 500k; on socketcan the link has it"),
}
"""What ``--help`` says of the options of python-can that most runs need: metavar and help."""


class CanopenKind(BusKind):
    """CiA 402 over any adapter of python-can. The options, or else the profile, name the node."""

    name, title = "canopen", "CANopen"
    named_by = "--interface and --channel, and --node"
    section, place_keys = "bus", "interface, channel"
    flags = MappingProxyType({
        "node": "--node", "interface": "--interface", "channel": "--channel", "bitrate": "--bitrate",
    })
    default_profile = PLAIN
    steps_over_a_wire = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add python-can's own options."""
        from can.cli import add_bus_arguments

        add_bus_arguments(parser, group_title="CAN bus (python-can's own options)")
        for action in parser._actions:  # python-can's own type does not accept 500k
            if action.dest in ("bitrate", "data_bitrate"):
                action.type = _bit_rate
            if (named := _OPTIONS.get(action.dest)) is not None:
                action.metavar, action.help = named

    def line(self, cli: Mapping[str, Any], rig: Rig | None, profile: Profile) -> BusConfig:
        """Return the bus as python-can is configured."""
        return bus_config(cli, rig)

    @property
    def nowhere(self) -> BusConfig:
        """Return a configuration without a bus."""
        return BusConfig()

    def placed_in(self, rig: Rig) -> bool:
        """Return whether ``bus:`` names an interface."""
        return rig.bus.interface is not None

    @contextmanager
    def open(self, plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
             tap: FrameTap, trace: Path | None) -> Iterator[Drive]:
        """Open the bus and the drive on it. The bus is shut down afterwards."""
        from drivers.canopen import CanopenDrive
        from drivers.undo_journal import UndoJournal

        profile, node = profile_of(connection), node_of(options, connection)
        with open_can(plan, connection, node, trace) as channel:
            yield CanopenDrive(
                channel,
                profile,
                clock,
                node=node,
                rate_hz=options.rate_hz,
                rated_torque_nm=rated_torque_nm(plan, profile, data),
                tap=tap,
                journal=None if plan.embedded else UndoJournal(plan.left_in or Path(options.log).parent, f"node{node}"),
            )

    @contextmanager
    def open_target(self, options: RunOptions, connection: Connection, clock: Clock) -> Iterator[Target]:
        """Open the bus and the node alone."""
        from drivers.canopen import CanopenTarget

        bus = can_bus.open_bus(config_of(connection))
        target = CanopenTarget(bus, profile_of(connection), clock, node=node_of(options, connection))
        try:
            yield target
        finally:
            target.close()

    def address(self, options: RunOptions, connection: Connection) -> str | None:
        """Return adapter, channel and node. None for python-can's virtual bus, which exists only in this process."""
        config = config_of(connection)
        if config.interface == "virtual":
            return None
        named = {name: str(config.value(name)) for name in _ADAPTER if name in config.settings}
        if "host" in named:
            named["host"] = one_host(named["host"])
        words = (f"canopen {config.interface} {config.channel}", *map(" ".join, named.items()))
        return " ".join((*words, f"node {node_of(options, connection)}"))

    def parse_faults(self, texts: Sequence[str]) -> tuple[Any, ...]:
        """Parse faults of `sim_bus.canopen`."""
        from sim_bus.canopen import parse_all

        return parse_all(texts)

    def faults(self) -> tuple[KnownFault, ...]:
        """Return the faults of `sim_bus.canopen`."""
        from sim_bus.canopen import listed

        return listed()

    def fault_listing(self) -> str:
        """Return the list of all faults of the simulated CANopen drive."""
        from sim_bus.canopen import listing

        return listing()


def _bit_rate(text: str) -> int:
    try:
        return int(read(text, BIT_RATE))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text[:60]!r}: {error}") from None


def profile_of(connection: Connection) -> CanopenProfile:
    """Return the drive's profile."""
    assert isinstance(connection.profile, CanopenProfile)
    return connection.profile


def config_of(connection: Connection) -> BusConfig:
    """Return the CAN bus."""
    assert isinstance(connection.line, BusConfig)
    return connection.line


def node_of(options: RunOptions, connection: Connection) -> int:
    """Return the node that the options, or else the profile, name."""
    return options.node if options.node is not None else profile_of(connection).node


def rated_torque_nm(plan: PeerPlan, profile: CanopenProfile, data: DriveData) -> float | None:
    """Return rig.yaml's rated torque; for a simulated motor without one, the plant's."""
    if data.rated_torque_nm is None and plan.embedded and profile.rated_torque_by_hand:
        return float(plan.plant.drive.rated_torque_nm)
    return data.rated_torque_nm


@contextmanager
def open_can(plan: PeerPlan, connection: Connection, node: int, trace: Path | None = None) -> Iterator[can.BusABC]:
    """Open the bus, with the simulated drive on it if requested. It is shut down afterwards."""
    with ExitStack() as stack:
        if plan.embedded:
            simulator, channel = _embedded(stack, plan, connection, node, trace)
            # Before the simulator continues alone to its end: what happens then is not part of the run.
            stack.callback(lambda: plan.never_came.extend(simulator.faults_waiting))
        else:
            channel = can_bus.open_bus(config_of(connection))
        stack.callback(channel.shutdown)
        yield channel


def _embedded(
    stack: ExitStack, plan: PeerPlan, connection: Connection, node: int, trace: Path | None
) -> tuple[Simulator, can.BusABC]:
    """Return the simulator and the host's bus to it. A stepped one runs in this thread, else in its own thread."""
    worn = None if connection.profile.name == PLAIN else profile_of(connection)
    if plan.stepped:
        from sim_bus.canopen import InlineSimulator

        inline = stack.enter_context(
            InlineSimulator(plan.plant, node_id=node, seed=plan.seed or 0, trace=trace, profile=worn,
                            faults=plan.faults)
        )
        return inline.simulator, inline.bus
    import can

    from sim_bus.canopen import EmbeddedSimulator

    simulated = stack.enter_context(
        EmbeddedSimulator(plan.plant, node_id=node, seed=plan.seed or 0, trace=trace, stepped=False, profile=worn,
                          faults=plan.faults)
    )
    return simulated.simulator, can.Bus(interface="virtual", channel=simulated.channel)


CANOPEN = CanopenKind()
