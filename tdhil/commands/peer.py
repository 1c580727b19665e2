"""The other end: an open bus with a drive on it, or the embedded simulator on a virtual one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.cia402.drive import Cia402Drive
from drivers.clock import Clock, MonotonicClock, SteppedClock
from drivers.drive import FrameTap
from profiles.library import load_canopen_profile
from tdhil.bus_options import BusConfig
from tdhil.options import Resolved


@dataclass(frozen=True)
class PeerPlan:
    """What will be opened. ``seed`` and ``plant`` are the embedded simulator's, None without it."""

    embedded: bool
    stepped: bool
    seed: int | None
    plant: Any

    @property
    def epoch_ns(self) -> int:
        """Wall clock at control time zero for the log's time stamps; stepped runs start at 0, so that they repeat."""
        return 0 if self.stepped else time.time_ns()


def plan_peer(options: Resolved, bus: BusConfig) -> PeerPlan:
    """The embedded simulator with --simulate, or when no bus is configured anywhere."""
    embedded = bool(options["simulate"]) or not bus.configured
    if not embedded:
        return PeerPlan(False, bool(options["stepped"]), None, None)
    from sim_bus.params import RigParams

    plant = RigParams()
    if options["plant"] is not None:
        from profiles.strict_yaml import load_model

        plant = load_model(Path(options["plant"]), RigParams)
    seed = options["seed"]
    if seed is None:
        import secrets

        seed = secrets.randbelow(2**31)
    return PeerPlan(True, not options["real_time"], seed, plant)


@contextmanager
def open_drive(plan: PeerPlan, options: Resolved, bus: BusConfig, bench_torque_nm: float | None, tap: FrameTap,
               trace: Path | None) -> Iterator[Cia402Drive]:
    """The drive, closed with its bus and simulator afterwards."""
    profile = load_canopen_profile(options["profile"])
    clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
    node = options["node"] if options["node"] is not None else profile.node
    with ExitStack() as stack:
        if plan.embedded:
            import can

            from sim_bus.simulator import EmbeddedSimulator

            simulator = stack.enter_context(
                EmbeddedSimulator(plan.plant, node_id=node, seed=plan.seed or 0, trace=trace, stepped=plan.stepped)
            )
            channel = can.Bus(interface="virtual", channel=simulator.channel)
        else:
            from tdhil.bus_open import open_bus

            channel = open_bus(bus)
        stack.callback(channel.shutdown)
        yield Cia402Drive(
            channel,
            profile,
            clock,
            node=node,
            rate_hz=options["rate_hz"],
            rated_torque_nm=bench_torque_nm,
            tap=tap,
        )
