"""The other end: a drive on its bus or line, or the embedded simulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivers.clock import Clock, MonotonicClock, SteppedClock
from drivers.drive import Drive, FrameTap
from tdhil.cli.connection import Connection, PeerPlan
from tdhil.config.options import RunOptions
from tdhil.config.rig import DriveData
from tdhil.errors import UsageError


def plan_peer(options: RunOptions, connection: Connection) -> PeerPlan:
    """The embedded simulator with --simulate, or when nobody says where a drive is. UsageError for stepped Modbus."""
    embedded = options.simulate or not connection.configured
    if not embedded:
        if options.stepped and connection.drive == "modbus":
            raise UsageError(
                "a Modbus line has no SYNC to step by: over a wire it runs in real time",
                where=options.source("stepped"),
                next_step="Leave --stepped out, or use --simulate, which is stepped",
            )
        return PeerPlan(False, options.stepped, None, None)
    from sim_bus.params import RigParams

    plant = RigParams()
    if options.plant is not None:
        from profiles.yaml_loader import load_model

        plant = load_model(Path(options.plant), RigParams)
    seed = options.seed
    if seed is None:
        import secrets

        seed = secrets.randbelow(2**31)
    return PeerPlan(True, not options.real_time, seed, plant)


@contextmanager
def open_drive(plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData | None, tap: FrameTap,
               trace: Path | None) -> Iterator[Drive]:
    """The drive, closed with its bus and simulator afterwards. ``data``: what the bench knows and the drive doesn't."""
    clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
    data = data or DriveData()
    if connection.drive == "modbus":
        from tdhil.cli.buses.modbus import open_modbus

        with open_modbus(plan, options, connection, data, clock, tap, trace) as modbus:
            yield modbus
    else:
        from tdhil.cli.buses.canopen import open_canopen

        with open_canopen(plan, options, connection, data, clock, tap, trace) as canopen:
            yield canopen
