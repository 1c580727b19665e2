"""The peer: a drive on its bus or line, or the embedded simulator."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from drivers import Clock, Drive, FrameTap, MonotonicClock, SteppedClock
from tdhil.buses import Connection, Opening, PeerPlan, bus_named
from tdhil.config import OPTION, DriveData, RunOptions
from tdhil.errors import MessageCode, UsageError
from tdhil.session.drive_lock import address_of, hold


def plan_peer(options: RunOptions, connection: Connection) -> PeerPlan:
    """Return the peer; embedded with --simulate or without an address. Raises UsageError for stepped Modbus."""
    embedded = options.simulate or not connection.configured
    if not embedded:
        if options.stepped and not connection.bus.steps_over_a_wire:
            raise UsageError(
                f"a {connection.bus.title} line has no SYNC, so it can't be stepped over a wire",
                where=options.source("stepped"),
                next_step="Remove --stepped, or use --simulate, which is stepped",
                entry=MessageCode.STEPPED_NEEDS_SYNC,
            )
        return PeerPlan(False, options.stepped, None, None)
    from sim_bus import RigParams

    plant = RigParams()
    if options.plant is not None:
        from profiles import load_model

        plant = load_model(Path(options.plant), RigParams)
    plant = plant.with_scales(
        options.simulated_torque_scale, options.simulated_speed_scale, options.simulated_added_inertia_kg_m2)
    seed = options.seed
    if seed is None:
        import secrets

        seed = secrets.randbelow(2**31)
    return PeerPlan(True, not options.real_time, seed, plant)


@contextmanager
def opened_drive(
    plan: PeerPlan, options: RunOptions, connection: Connection, data: DriveData | None, tap: FrameTap,
    trace: Path | None,
) -> Iterator[Drive]:
    """Open the drive and lock it against other programs. Drive, bus and simulator are closed afterwards.

    ``data``: facts of the bench that the drive does not report. Raises DriveHeld if another process holds the drive.
    """
    clock: Clock = SteppedClock() if plan.stepped else MonotonicClock()
    data = data or DriveData()
    address = None if plan.embedded else address_of(connection, options)
    opening = Opening(plan, options, connection, data, clock, tap, trace)
    with hold(address), connection.bus.open(opening) as drive:
        yield drive


def with_faults(plan: PeerPlan, texts: Sequence[str] | None, drive: str) -> PeerPlan:
    """Return the plan with these faults. Raises UsageError if the peer is not the embedded simulator."""
    if not texts:
        return plan
    if not plan.embedded:
        raise UsageError(
            "faults can be scripted in the embedded simulator only", where=OPTION["fault"].flag,
            next_step="Add --simulate, or give --fault to tdhil simulate",
            entry=MessageCode.FAULTS_NEED_SIMULATOR,
        )
    return replace(plan, faults=bus_named(drive).parse_faults(texts))
