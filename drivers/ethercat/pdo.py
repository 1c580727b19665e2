"""PDO mapping by CoE (1600h, 1A00h) and assignment to the sync managers (1C12h, 1C13h), and the process image.

tdhil writes in PRE-OP, in the order of ETG.1000.6: empty the assignment, empty the mapping, fill it, assign it. A drive
with fixed PDOs gets its assignment only. In both cases the content is read back, and the image follows the content that
was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

from drivers import cia402
from drivers.errors import PreflightRefused
from profiles import MessageCode
from profiles.cia402 import ObjectType, Position
from profiles.ethercat import EthercatProfile

OUTPUTS, INPUTS = 0x1C12, 0x1C13
"""Assignment of RxPDOs to sync manager 2, and of TxPDOs to sync manager 3."""
Mapped = tuple[int, int, int]
"""Index, sub-index and bits of a mapped object; index 0 is a gap."""
_SIGNED = {8: Struct("<b"), 16: Struct("<h"), 32: Struct("<i")}
_WORD = Struct("<H")
_GAP: Mapped = (0, 0, 8)


@dataclass(frozen=True)
class Image:
    """One direction of the process data: objects with their byte offsets, and the length in bytes."""

    offsets: dict[tuple[int, int], tuple[int, int]]        # index, sub-index → offset in bytes, bits
    size: int

    @classmethod
    def of(cls, mapped: Sequence[Mapped]) -> Image:
        """Return the image of these objects, in their order."""
        offsets: dict[tuple[int, int], tuple[int, int]] = {}
        at = 0
        for index, sub, bits in mapped:
            if index and at % 8 == 0:
                offsets.setdefault((index, sub), (at // 8, bits))
            at += bits
        return cls(offsets, (at + 7) // 8)

    def missing(self, wanted: Sequence[Mapped]) -> list[str]:
        """Return the names of those objects that are not in the image, on whole bytes and with their length."""
        return [cia402.name(index, sub) for index, sub, bits in wanted
                if self.offsets.get((index, sub), (0, 0))[1] != bits]


class SetpointImage:
    """Outputs of the host in one cycle, packed into the image."""

    def __init__(self, image: Image, content: cia402.CyclicObjects) -> None:
        self.data = bytearray(image.size)
        offset = content.offset
        places = [cia402.CONTROLWORD, cia402.TARGET_TORQUE, content.target_speed, cia402.MODE, offset or _GAP]
        self._places = [
            None if found is None else (_WORD if place is cia402.CONTROLWORD else _SIGNED[found[1]], found[0])
            for place in places for found in (image.offsets.get(place[:2]),)
        ]

    def pack(self, setpoints: cia402.CycleSetpoints) -> None:
        """Write the setpoints of one cycle."""
        for place, value in zip(self._places, setpoints[:5], strict=True):
            if place is not None:
                place[0].pack_into(self.data, place[1], value)

    @property
    def word(self) -> int:
        """The controlword in the image."""
        place = self._places[0]
        return 0 if place is None else int(place[0].unpack_from(self.data, place[1])[0])

    def stop(self, word: int) -> None:
        """Set this controlword, and torque, speed and torque offset to zero; the mode stays."""
        for number, value in ((0, word), (1, 0), (2, 0), (4, 0)):
            place = self._places[number]
            if place is not None:
                place[0].pack_into(self.data, place[1], value)


class FeedbackImage:
    """Inputs of the host: values of the objects in the image. An object that is not mapped gives None."""

    def __init__(
        self, image: Image, content: cia402.CyclicObjects, position: Position | None, torque: ObjectType = "i16"
    ) -> None:
        self.size = image.size
        self._status = self._at(image, cia402.STATUSWORD, _WORD)
        self._torque = self._at(image, content.torque, cia402.LAYOUTS[torque])
        self._speed = self._at(image, content.actual_speed)
        self._shown = self._at(image, cia402.MODE_DISPLAY)
        self._demand = self._at(image, cia402.TORQUE_DEMAND)
        self._angle = None if position is None else self._at(
            image, (position.index, position.sub, cia402.bits_of(position.type)), cia402.LAYOUTS[position.type])

    @staticmethod
    def _at(image: Image, place: Mapped, layout: Struct | None = None) -> tuple[Struct, int] | None:
        found = image.offsets.get(place[:2])
        return None if found is None else (layout or _SIGNED[found[1]], found[0])

    def unpack(self, data: bytes) -> tuple[int, float, int, int, int | None, float | None]:
        """Return status, torque, speed, mode display, torque demand and angle, in counts."""
        status, torque, speed, shown, demand, angle = (
            None if place is None else place[0].unpack_from(data, place[1])[0]
            for place in (self._status, self._torque, self._speed, self._shown, self._demand, self._angle)
        )
        return status or 0, torque or 0, speed or 0, shown or 0, demand, angle


# ---------------------------------------------------------------------------------------------------------------------


def wanted_outputs(content: cia402.CyclicObjects) -> tuple[Mapped, ...]:
    """Return the setpoints that the host needs in the cycle."""
    torque = (cia402.TARGET_TORQUE,) if content.target_torque else ()
    mode = (cia402.MODE,) if content.mode else ()
    offset = () if content.offset is None else (content.offset,)
    return (cia402.CONTROLWORD, *torque, content.target_speed, *mode, *offset)


def wanted_inputs(content: cia402.CyclicObjects) -> tuple[Mapped, ...]:
    """Return the feedback that the host needs in the cycle."""
    return (cia402.STATUSWORD, content.torque, content.actual_speed, cia402.MODE_DISPLAY)


def map_images(
    objects: cia402.Objects, profile: EthercatProfile, content: cia402.CyclicObjects, demand: bool,
    position: Position | None,
) -> tuple[Image, Image]:
    """Map and assign both directions. Return the images that were read back.

    Raises ObjectRefused, or PreflightRefused if an object that the host needs is not in the image.
    """
    cyclic, outputs, inputs = profile.cyclic, wanted_outputs(content), wanted_inputs(content)
    extra = ((cia402.TORQUE_DEMAND,) if demand else ()) + (
        () if position is None else ((position.index, position.sub, cia402.bits_of(position.type)),))
    found = []
    for assign, pdos, mapped in ((OUTPUTS, cyclic.rx_pdos, outputs), (INPUTS, cyclic.tx_pdos, (*inputs, *extra))):
        if cyclic.fixed:
            _assign(objects, assign, pdos)
        else:
            _map(objects, assign, pdos[0], mapped)
        found.append(Image.of([one for pdo in pdos for one in _entries(objects, pdo)]))
    missing = found[0].missing(outputs) + found[1].missing(inputs)
    if missing:
        raise PreflightRefused(
            f"the PDOs do not carry {', '.join(missing)}", where="1C12h, 1C13h",
            next_step="Name other PDOs in the profile (cyclic: rx_pdos, tx_pdos), or set the drive's PDOs with the "
            "manufacturer's tool", entry=MessageCode.PDO_NOT_POSSIBLE,
        )
    return found[0], found[1]


def settings(objects: cia402.Objects, profile: EthercatProfile) -> list[cia402.FeedbackSetting]:
    """Return the objects that define the content of the feedback: assignment and mapping of the TxPDOs."""
    places = [(INPUTS, sub) for sub in range(1 + len(profile.cyclic.tx_pdos))]
    for pdo in profile.cyclic.tx_pdos:
        places += [(pdo, sub) for sub in range(1 + objects.read(pdo, 0))]
    return [("the content of the feedback", index, sub, objects.read_bytes(index, sub)) for index, sub in places]


def _map(objects: cia402.Objects, assign: int, pdo: int, mapped: Sequence[Mapped]) -> None:
    former = [entry(one) for one in _entries(objects, pdo)]
    before = _assigned(objects, assign)

    def write(entries: Sequence[int], pdos: Sequence[int]) -> None:
        objects.write(assign, 0, 0, 8)
        objects.write(pdo, 0, 0, 8)
        for number, one in enumerate(entries, start=1):
            objects.write(pdo, number, one, 32)
        objects.write(pdo, 0, len(entries), 8)
        _write_assignment(objects, assign, pdos)

    objects.on_restore(lambda: write(former, before))
    write([entry(one) for one in mapped], [pdo])


def _assign(objects: cia402.Objects, assign: int, pdos: Sequence[int]) -> None:
    before = _assigned(objects, assign)
    if before != list(pdos):
        objects.on_restore(lambda: _write_assignment(objects, assign, before))
        _write_assignment(objects, assign, pdos)


def _write_assignment(objects: cia402.Objects, assign: int, pdos: Sequence[int]) -> None:
    objects.write(assign, 0, 0, 8)
    for number, pdo in enumerate(pdos, start=1):
        objects.write(assign, number, pdo, 16)
    objects.write(assign, 0, len(pdos), 8)


def _assigned(objects: cia402.Objects, assign: int) -> list[int]:
    return [objects.read(assign, sub) for sub in range(1, 1 + objects.read(assign, 0))]


def _entries(objects: cia402.Objects, pdo: int) -> list[Mapped]:
    found = [objects.read(pdo, sub) for sub in range(1, 1 + objects.read(pdo, 0))]
    return [(one >> 16, one >> 8 & 0xFF, one & 0xFF) for one in found]


def entry(mapped: Mapped) -> int:
    """Return the mapping entry of an object (ETG.1000.6: index, sub-index, bits)."""
    return mapped[0] << 16 | mapped[1] << 8 | mapped[2]
