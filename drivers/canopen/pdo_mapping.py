"""PDO mapping and communication parameters, written by SDO (CiA 301, 1400h…1A03h).

Real drives map 6040h alone, or 6040h with 60FFh, into their first RPDOs, and none maps 6071h. So tdhil always writes
the mapping, in the order of the standard: disable the PDO, empty the mapping, fill it, set the transmission type,
enable.
"""

from dataclasses import dataclass

from drivers.canopen.pdo import STANDARD, FrameShape, Slow
from drivers.cia402 import Mapped, Objects, mapping_entry, name, read_entries, write_entries
from drivers.errors import PreflightRefused
from profiles import MessageCode

DISABLED, NO_REMOTE, EXTENDED = 1 << 31, 1 << 30, 1 << 29
SLOW_SYNCS, SLOW_S = 5, 0.1
"""Number of SYNCs between two TPDO2 (mode display, torque demand, angle), and longest interval, s. The control loop
does not need TPDO2 in each cycle, and fewer frames limit the bus load. With a slow cycle TPDO2 comes more often: a lost
mode, and an angle, must show within 0.1 s or one cycle."""
_LEAST_RPDOS, _MOST_RPDOS = 8, 64
"""Number of RPDOs that are read: the first eight in any case, because numbers may be missing; then further ones, up to
64, until one is missing."""


@dataclass(frozen=True)
class PdoMapping:
    """Required state of one PDO: ``number`` counts from 1, ``sync_type`` is its transmission type (1 = every SYNC)."""

    receive: bool                  # True for an RPDO, which the drive receives
    number: int
    sync_type: int
    mapped: tuple[Mapped, ...]

    @property
    def communication(self) -> int:
        return (0x1400 if self.receive else 0x1800) + self.number - 1

    @property
    def mapping(self) -> int:
        return (0x1600 if self.receive else 0x1A00) + self.number - 1

    def identifier(self, node: int) -> int:
        """Return the COB-ID of the predefined connection set (CiA 301): RPDO1 200h, TPDO1 180h, and 100h more for each
        next PDO.
        """
        return (0x200 if self.receive else 0x180) + 0x100 * (self.number - 1) + node


def slow_syncs(period_s: float) -> int:
    """Return the number of SYNCs between two TPDO2."""
    return max(1, min(SLOW_SYNCS, round(SLOW_S / period_s)))


def layout(carried: Slow, shape: FrameShape = STANDARD, slow: int = SLOW_SYNCS) -> tuple[PdoMapping, ...]:
    """Return RPDO1, TPDO1, RPDO2 (`mode_and_offset`), TPDO2 with the ``carried`` objects; ``slow``: `slow_syncs`."""
    feedback = shape.actual[shape.wide :]
    modes = (PdoMapping(True, 2, 1, shape.mode_and_offset),) if shape.mode_and_offset else ()
    return (
        PdoMapping(True, 1, 1, shape.targets), PdoMapping(False, 1, 1, feedback), *modes,
        PdoMapping(False, 2, 1 if shape.wide else slow, carried.mapped),
    )


def written(pdo: PdoMapping) -> str:
    """Return the objects in the PDO, as manuals write them: 6040+6071+60FF."""
    return "+".join(f"{index:04X}:{sub}" if sub else f"{index:04X}" for index, sub, _ in pdo.mapped)


def write_pdo(objects: Objects, node: int, pdo: PdoMapping) -> None:
    """Map one PDO and read it back; `Objects.restore` restores the former mapping.

    Raises ObjectRefused, or PreflightRefused if another mapping reads back.
    """
    identifier = pdo.identifier(node)
    wanted = [mapping_entry(mapped) for mapped in pdo.mapped]
    communication = pdo.communication
    former = read_entries(objects, pdo.mapping), objects.read(communication, 2), objects.read(communication, 1)
    objects.on_restore(lambda: _write(objects, pdo, *former))
    _write(objects, pdo, wanted, pdo.sync_type, identifier | kept_bits(former[2]))
    found = read_entries(objects, pdo.mapping)
    if found != wanted:
        raise PreflightRefused(
            f"the PDO mapping reads back as {[f'{entry:08X}h' for entry in found]}",
            where=name(pdo.mapping),
            next_step="The mapping of this drive may be fixed. Then tdhil can't get torque and speed of one instant",
            entry=MessageCode.PDO_NOT_POSSIBLE,
        )
    cob_id, sync_type = objects.read(pdo.communication, 1), objects.read(pdo.communication, 2)
    if cob_id & (DISABLED | 0x7FF) != identifier or sync_type != pdo.sync_type:
        raise PreflightRefused(
            f"the PDO reads back with COB-ID {cob_id:08X}h and transmission type {sync_type}",
            where=name(pdo.communication),
            next_step=f"It must be {identifier:X}h, enabled, and of type {pdo.sync_type} (synchronous)",
            entry=MessageCode.PDO_NOT_POSSIBLE,
        )


def kept_bits(cob_id: int) -> int:
    """Return the drive's own bits of a COB-ID (CiA 301, 1800h): bit 30 (no remote frames), which some drives keep at 1,
    and bits 11 to 28, which belong to the identifier in an extended frame only (bit 29).
    """
    return cob_id & (NO_REMOTE if cob_id & EXTENDED else NO_REMOTE | 0x1FFF_F800)


def switch_off_others(objects: Objects, ours: tuple[PdoMapping, ...]) -> dict[int, int]:
    """Switch off every enabled RPDO that is not ours (bit 31 of its COB-ID). Return former COB-IDs by RPDO number.

    The setpoints of another master would act through it beside ours (CiA 301, 1400h). `Objects.restore` enables it
    again. Raises ObjectRefused or PreflightRefused if it can't be switched off.
    """
    found: dict[int, int] = {}
    own = {pdo.number for pdo in ours if pdo.receive}
    for number in range(1, _MOST_RPDOS + 1):
        index = 0x1400 + number - 1
        cob_id = None if number in own else objects.read_if_there(index, 1)
        if cob_id is None and number not in own and number > _LEAST_RPDOS:
            break
        if cob_id is None or cob_id & DISABLED:
            continue
        if not objects.change(index, 1, cob_id | DISABLED, 32) & DISABLED:
            raise PreflightRefused(
                f"RPDO{number} (COB-ID {cob_id & 0x7FF:X}h) stays on; setpoints of another master could act through it",
                where=name(index, 1), next_step="Switch it off with the manufacturer's tool",
                entry=MessageCode.ANOTHER_MASTER,
            )
        found[number] = cob_id
    return found


def _write(objects: Objects, pdo: PdoMapping, entries: list[int], sync_type: int, cob_id: int) -> None:
    objects.write(pdo.communication, 1, DISABLED | cob_id, 32)
    write_entries(objects, pdo.mapping, entries)
    objects.write(pdo.communication, 2, sync_type, 8)
    if not cob_id & DISABLED:
        objects.write(pdo.communication, 1, cob_id, 32)
