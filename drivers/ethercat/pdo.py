"""PDO mapping by CoE (1600h, 1A00h), and its assignment to the sync managers (1C12h, 1C13h).

tdhil writes in PRE-OP, in the order of ETG.1000.6: empty the assignment, empty the mapping, fill it, assign it. A drive
with fixed PDOs gets its assignment only. In both cases the content is read back, and the places of the values in the
process data follow the content that was read.
"""

from __future__ import annotations

from collections.abc import Sequence

from drivers.cia402 import (
    MODE_DISPLAY,
    TORQUE_DEMAND,
    CyclicLayout,
    CyclicObjects,
    FeedbackSetting,
    Mapped,
    Objects,
    angle_object,
    mapped_object,
    mapping_entry,
    read_entries,
    write_entries,
)
from drivers.errors import PreflightRefused
from profiles import MessageCode
from profiles.cia402 import Position
from profiles.ethercat import EthercatProfile

OUTPUTS, INPUTS = 0x1C12, 0x1C13
"""Assignment of RxPDOs to sync manager 2, and of TxPDOs to sync manager 3."""


def map_cyclic(
    objects: Objects, profile: EthercatProfile, content: CyclicObjects, demand: bool, position: Position | None
) -> tuple[CyclicLayout, CyclicLayout]:
    """Map and assign both directions. Return the layouts of the content that was read back.

    The setpoints are those of `CycleSetpoints`; the feedback is statusword, torque, speed, mode display, torque demand
    and angle. Raises ObjectRefused, or PreflightRefused if an object that the host needs is not mapped.
    """
    cyclic, angle = profile.cyclic, angle_object(position)
    outputs, inputs = (*content.targets, *content.mode_and_offset), (*content.actual, MODE_DISPLAY)
    extra = (TORQUE_DEMAND,) * demand + (() if angle is None else (angle,))
    setpoints = CyclicLayout(_mapped(objects, profile, OUTPUTS, cyclic.rx_pdos, outputs), content.setpoints)
    feedback = CyclicLayout(
        _mapped(objects, profile, INPUTS, cyclic.tx_pdos, inputs + extra), (*inputs, TORQUE_DEMAND, angle),
        content.kinds(position),
    )
    missing = setpoints.missing(outputs) + feedback.missing(inputs)
    if missing:
        raise PreflightRefused(
            f"the PDOs do not carry {', '.join(missing)}", where="1C12h, 1C13h",
            next_step="Name other PDOs in the profile (cyclic: rx_pdos, tx_pdos), or set the drive's PDOs with the "
            "manufacturer's tool", entry=MessageCode.PDO_NOT_POSSIBLE,
        )
    return setpoints, feedback


def settings(objects: Objects, profile: EthercatProfile) -> list[FeedbackSetting]:
    """Return the objects that define the content of the feedback: assignment and mapping of the TxPDOs."""
    return [
        ("the content of the feedback", index, sub, objects.read_bytes(index, sub))
        for index in (INPUTS, *profile.cyclic.tx_pdos) for sub in range(1 + objects.read(index, 0))
    ]


def _mapped(
    objects: Objects, profile: EthercatProfile, assign: int, pdos: Sequence[int], wanted: Sequence[Mapped]
) -> list[Mapped]:
    """Map the wanted objects in the first PDO, unless all are fixed, and assign. Return the content read back."""
    fixed, pdo = profile.cyclic.fixed, pdos[0]
    former = [] if fixed else read_entries(objects, pdo)
    before = read_entries(objects, assign)

    def write(entries: Sequence[int], assigned: Sequence[int]) -> None:
        if not fixed:
            objects.write(assign, 0, 0, 8)
            write_entries(objects, pdo, entries)
        write_entries(objects, assign, assigned, 16)

    if not fixed or before != list(pdos):
        objects.on_restore(lambda: write(former, before))
        write([mapping_entry(one) for one in wanted], pdos)
    return [mapped_object(one) for number in pdos for one in read_entries(objects, number)]
