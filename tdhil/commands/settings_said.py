"""How a run was set up: what is printed of it, and what its log keeps."""

from __future__ import annotations

from datetime import datetime
from typing import TYPE_CHECKING, Any

from tdhil import __version__

if TYPE_CHECKING:
    from rich.console import Console

    from tdhil.cli.connection import Connection
    from tdhil.cli.open_drive import PeerPlan
    from tdhil.config.options import RunOptions
    from tdhil.config.rig import Rig


def configuration(options: RunOptions, connection: Connection, peer: PeerPlan, rig: Rig | None) -> dict[str, Any]:
    """For the log: everything that identification needs.

    And the whole profile, so that a later decoder can start again from the raw frames.
    """
    return {
        "tdhil": __version__,
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "rig_file": None if rig is None or not rig.file else rig.file,
        "options": {name: {"value": value, "source": source} for name, value, source in options.rows()},
        "drive": connection.drive,
        "bus": {name: {"value": value, "source": source} for name, value, source in connection.rows()},
        "profile": connection.profile.model_dump(mode="json", by_alias=True),
        "embedded_simulator": peer.embedded,
        "stepped": peer.stepped,
        "seed": peer.seed,
        "plant": None if peer.plant is None else peer.plant.model_dump(mode="json"),
        "faults": [fault.text for fault in peer.faults],
        "identify": {"confidence": options.confidence, "tolerance": options.tolerance, "model": options.model},
        "converted": [list(row) for row in rig.conversions] if rig is not None else [],
        "reference_inertia_kg_m2": None if rig is None else rig.reference_inertia_kg_m2,
    }


def show_settings(
    console: Console, options: RunOptions, connection: Connection, peer: PeerPlan, rig: Rig | None = None
) -> None:
    """Which value came from where: everything that isn't a default; and what became of a value with a unit."""
    if peer.embedded:
        why = "as asked for" if options.simulate else connection.nothing_there
        clock = "stepped time" if peer.stepped else "real time"
        what = "Modbus drive and rig" if connection.drive == "modbus" else "drive and rig on a virtual bus"
        console.print(f"SIMULATED: embedded {what} ({why}), {clock}, seed {peer.seed}", style="magenta")
        for fault in peer.faults:
            console.print(f"SIMULATED: scripted fault {fault.text}", style="magenta", markup=False)
    else:
        for name, value, source in connection.rows():
            console.print(f"{_PREFIX[connection.drive]} {name:<10} {value}  ({source})", style="dim", markup=False)
    for name, value, source in options.rows():
        if source != "default":
            console.print(f"{name:<14} {value}  ({source})", style="dim", markup=False)
    for key, text, source in rig.conversions if rig is not None else ():
        console.print(f"{key:<14} {text}  ({source})", markup=False)


_PREFIX = {"canopen": "bus", "modbus": "line"}
