"""A simulated CiA 402 drive with an object dictionary, on any bus: our own EDS or a profile, errors, the host's cycles.

It adds the objects to `TimedDrive`. The communication objects of a bus are the bus's own.
"""

from canopen.objectdictionary import datatypes

from profiles import MARKER_INDEX
from profiles.cia402 import Cia402Profile
from sim_bus.application_objects import ApplicationObjects
from sim_bus.emergency import COMMUNICATION, GENERIC, HOST_LOST, Emergency
from sim_bus.objects import ObjectStore, generic_eds, key_of
from sim_bus.params import RigParams
from sim_bus.profile_emulation import WornProfile
from sim_bus.timed_drive import TimedDrive
from sim_bus.trace import ShaftTrace


class ObjectDrive(TimedDrive):
    """A drive with its objects. A subclass connects them to its bus."""

    error_register = GENERIC
    """Bits of 1001h for an error of the drive itself."""

    def __init__(self, params: RigParams, *, node_id: int, seed: int, trace: ShaftTrace, stepped: bool,
                 profile: Cia402Profile | None) -> None:
        super().__init__(params, seed=seed, trace=trace, stepped=stepped)
        self.cycled = False
        """True after a cycle of the host has come."""
        self.period_us = 0
        """Period of a cycle in stepped time, µs."""
        self.store = ObjectStore(node_id, generic_eds())
        self.emergency = Emergency(self.store, self.send_emergency)
        for sub, kind, text, value in ((1, datatypes.UNSIGNED8, "Interpolation time period", 1),
                                       (2, datatypes.INTEGER8, "Interpolation time index", -3),
                                       (0, datatypes.UNSIGNED8, "Entries", 2)):
            self.store.add(0x60C2, sub, kind, writable=sub > 0, mappable=False, name=text, default=value)
        worn = WornProfile(profile, self.application) if profile is not None else None
        self.setters = ApplicationObjects(self.store, self.application, worn.units if worn else None).setters
        if worn is not None:
            worn.apply(self.store)
        self.application.on_event = self.note
        self.application.on_fault_reset = self.emergency.reset

    def send_emergency(self, message: bytes) -> None:
        """Send an emergency message to the host."""
        raise NotImplementedError

    def set_period(self, period_us: int) -> None:
        """Set the period of a cycle in stepped time."""
        self.period_us = period_us

    def add_period(self) -> None:
        """Add 5FFEh:3, the period of a cycle in stepped time, for a drive without another object of it."""
        self.store.add(MARKER_INDEX, 3, datatypes.UNSIGNED32, writable=True, mappable=False, name="Stepped period",
                       default=0)
        self.store.hooks[key_of(MARKER_INDEX, 3)] = self.set_period

    def lose_host(self) -> None:
        """React to a silent host: error code 8130h, and the reaction of 6007h."""
        self.emergency.report(HOST_LOST, COMMUNICATION)
        self.application.warning = True
        self.application.abort_connection()

    def pass_cycle(self) -> None:
        """Advance by one period in stepped time after a cycle of the host, whether or not it has arrived."""
        self.cycled = True
        if self.stepped and self.period_us:
            self.advance_us(self.period_us)
