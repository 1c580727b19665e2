"""A CANopen drive on an open bus, or the embedded simulator on a virtual one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers import Clock, FrameTap
from drivers.canopen import Cia402Drive
from drivers.left_behind import LeftBehind
from profiles.canopen import CanopenProfile
from tdhil.config import DriveData, RunOptions
from tdhil.session.connection import BusKind, Connection, rated_torque_is_told_by_hand

if TYPE_CHECKING:
    import can

    from sim_bus.canopen import Simulator
    from tdhil.session.connection import PeerPlan

PLAIN = "generic/cia402"
"""What the simulator is when it wears no profile."""


@contextmanager
def open_canopen(plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData, clock: Clock,
                 tap: FrameTap, trace: Path | None) -> Iterator[Cia402Drive]:
    """The node that the options, or else the profile, name."""
    profile = connection.profile
    assert isinstance(profile, CanopenProfile)
    node = options.node if options.node is not None else profile.node
    with open_can(plan, connection, node, trace) as channel:
        yield Cia402Drive(
            channel,
            profile,
            clock,
            node=node,
            rate_hz=options.rate_hz,
            rated_torque_nm=rated_torque_nm(plan, profile, data),
            tap=tap,
            left=None if plan.embedded else LeftBehind(Path(options.log).parent, f"node{node}"),
        )


def rated_torque_nm(plan: PeerPlan, profile: CanopenProfile, data: DriveData) -> float | None:
    """As rig.yaml has it; a simulated motor has no plate to read it from."""
    if data.rated_torque_nm is None and plan.embedded and rated_torque_is_told_by_hand(profile):
        return float(plan.plant.drive.rated_torque_nm)
    return data.rated_torque_nm


@contextmanager
def open_can(plan: PeerPlan, connection: Connection, node: int, trace: Path | None = None) -> Iterator[can.BusABC]:
    """The bus, shut down afterwards, with the simulated drive on it where one was asked for."""
    with ExitStack() as stack:
        if plan.embedded:
            simulator, channel = _embedded(stack, plan, connection, node, trace)
            # Before the simulator runs out by itself: what comes then is no part of the run.
            stack.callback(lambda: plan.never_came.extend(simulator.faults_waiting))
        else:
            from tdhil.session.buses.can_bus import open_bus

            channel = open_bus(connection.bus)
        stack.callback(channel.shutdown)
        yield channel


def _embedded(
    stack: ExitStack, plan: PeerPlan, connection: Connection, node: int, trace: Path | None
) -> tuple[Simulator, can.BusABC]:
    """The simulator and the host's bus to it: in this thread where it is stepped, else in one of its own."""
    worn = None if connection.profile.name == PLAIN else connection.profile
    assert worn is None or isinstance(worn, CanopenProfile)
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


def _faults(texts: Sequence[str]) -> tuple[Any, ...]:
    from sim_bus.canopen import parse_all

    return parse_all(texts)


CANOPEN = BusKind(open_canopen, _faults, steps_over_a_wire=True)
