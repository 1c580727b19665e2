"""Who is at a node-ID: found, read out (CiA 301: 1000h, 1018h, 1008h), and refused where it is in doubt."""

from drivers.canopen.preflight import refuse_if_driven
from drivers.canopen.sdo import Objects, name
from drivers.drive import Identity
from drivers.errors import CommunicationLost, ObjectRefused, PreflightRefused
from profiles.simulator_marker import MARKER_INDEX, MARKER_TEXT
from profiles.visible import visible

DOUBLED_ANSWERS = 3
"""So many answers that came twice are no accident; `Cia402Drive.connect` asks some ten questions."""


def find_free_node(objects: Objects) -> None:
    """Somebody answers, and nobody else drives it. Nothing is written. Raises PreflightRefused."""
    try:
        objects.read(0x1000)
    except CommunicationLost as error:
        raise PreflightRefused(error.what, where=error.where, next_step=error.next_step) from error
    refuse_if_driven(objects)


def read_identity(objects: Objects) -> Identity:
    """Vendor, product, revision and serial number (0 where there is none), name, and whether it is simulated."""
    vendor, product, revision, serial = (objects.read_if_there(0x1018, sub) or 0 for sub in (1, 2, 3, 4))
    try:
        title = visible(objects.read_bytes(0x1008).decode("ascii", "replace").rstrip("\0 "))
    except ObjectRefused:
        title = "CiA 402 drive"
    return Identity(vendor, product, revision, serial, title, _is_simulated(objects))


def refuse_in_doubt(objects: Objects, identity: Identity, node: int, stepped: bool) -> None:
    """A real drive in stepped time, and two nodes with one node-ID. Raises PreflightRefused."""
    if stepped and not identity.simulated:
        raise PreflightRefused(
            "stepped time was asked for, but the peer does not bear the simulator's marker",
            where=name(MARKER_INDEX, 1),
            next_step="Leave --stepped out: a real shaft moves in real time",
        )
    if objects.doubled >= DOUBLED_ANSWERS:
        raise PreflightRefused(
            "every question is answered twice: two nodes have the same node-ID",
            where=f"node {node}",
            next_step="Take one of them off the bus, or give each a node-ID of its own",
        )


def _is_simulated(objects: Objects) -> bool:
    try:
        return objects.read_bytes(MARKER_INDEX, 1).decode("ascii", "replace").rstrip("\0") == MARKER_TEXT
    except ObjectRefused:
        return False
