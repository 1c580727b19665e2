"""Changes that a profile makes on CANopen: the watchdog, the period of stepped time, and the default mapping."""

from canopen.objectdictionary import datatypes

from profiles.canopen import CanopenProfile
from sim_bus.canopen.services import LifeGuard
from sim_bus.object_drive import ObjectDrive
from sim_bus.objects import key_of


def apply_on_canopen(profile: CanopenProfile, drive: ObjectDrive, guard: LifeGuard) -> None:
    """Add and remove the objects of the communication area, after those of the profile on any bus."""
    watchdog, store = profile.watchdog, drive.store
    if not profile.cyclic.has_period:
        store.remove(0x1006)
        drive.add_period()
    if watchdog.kind != "heartbeat" or watchdog.consumer_index != 0x1016:
        store.remove(0x1016)
    if watchdog.kind == "node_guarding":
        for index, kind, hook in (
            (0x100C, datatypes.UNSIGNED16, guard.set_guard), (0x100D, datatypes.UNSIGNED8, guard.set_factor),
        ):
            store.add(index, 0, kind, writable=True, mappable=False, name=f"Guarding {index:04X}")
            store.set_default(index, 0, 0)
            store.hooks[key_of(index)] = hook
    for area in (0x1600, 0x1A00):            # a PDO that names a missing object maps nothing by default
        for mapping in range(area, area + 4):
            entries = [store.default(key_of(mapping, 1 + number)) for number in range(8)]
            if any(entry and entry >> 16 not in store.object_dictionary for entry in entries):
                for sub in range(9):
                    store.set_default(mapping, sub, 0)
