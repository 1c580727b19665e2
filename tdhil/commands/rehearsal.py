"""`tdhil identify --simulate --fault …`: what the embedded drive shall do wrong, and when."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tdhil.cli.open_drive import PeerPlan
from tdhil.errors import UsageError


def with_faults(plan: PeerPlan, texts: Sequence[str] | None, drive: str) -> PeerPlan:
    """The plan with these faults. UsageError where the peer isn't ours to spoil."""
    if not texts:
        return plan
    if not plan.embedded:
        raise UsageError(
            "faults can be scripted in the embedded simulator only", where="--fault",
            next_step="Add --simulate, or give --fault to tdhil simulate",
        )
    if drive == "modbus":
        from sim_bus.modbus.fault_catalogue import parse_all as parse_modbus

        return replace(plan, faults=parse_modbus(texts, "embedded"))
    from sim_bus.fault_catalogue import parse_all

    return replace(plan, faults=parse_all(texts))


def list_faults() -> int:
    """Prints what there is; the exit code."""
    from sim_bus.fault_catalogue import listing
    from sim_bus.modbus.fault_catalogue import listing as listing_of_modbus

    print(f"--drive canopen\n\n{listing()}\n\n--drive modbus\n\n{listing_of_modbus()}")  # noqa: T201
    return 0
