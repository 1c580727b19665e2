"""The object dictionary in the drive: values, live objects, write hooks, limits, abort codes.

Keys are ``index << 8 | subindex``. A *live* object is read from the drive at the moment of the request. A *hook* gets a
value before it is stored and may refuse it with an SDO abort. This replaces the data store and the callbacks of
canopen's LocalNode, because its callbacks start a heartbeat thread on 1017h. Its SDO server is kept.
"""

from collections.abc import Callable
from importlib.resources import files
from math import isfinite

import canopen
from canopen import objectdictionary
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from canopen.sdo import SdoAbortedError

ABORT_READ_WRITE_ONLY = 0x06010001
ABORT_WRITE_READ_ONLY = 0x06010002
ABORT_NO_OBJECT = 0x06020000
ABORT_NOT_MAPPABLE = 0x06040041
ABORT_PDO_TOO_LONG = 0x06040042
ABORT_LENGTH = 0x06070010
ABORT_NO_SUBINDEX = 0x06090011
ABORT_VALUE = 0x06090030
ABORT_TOO_HIGH = 0x06090031
ABORT_TOO_LOW = 0x06090032
ABORT_STATE = 0x08000022
ABORT_NO_DATA = 0x08000024

FORMATS = {
    datatypes.INTEGER8: "b", datatypes.UNSIGNED8: "B", datatypes.INTEGER16: "h", datatypes.UNSIGNED16: "H",
    datatypes.INTEGER32: "i", datatypes.UNSIGNED32: "I", datatypes.REAL32: "f",
}
"""`struct` formats of the data types that a PDO may carry."""

TEXT_LIMIT = 512
"""Largest length of a text that a host may write, bytes."""

Value = int | float | str


def key_of(index: int, subindex: int = 0) -> int:
    """Return the key of an object."""
    return index << 8 | subindex


def generic_eds() -> str:
    """Return the path of our own EDS."""
    return str(files("profiles") / "generic" / "cia402.eds")


class ObjectStore(canopen.LocalNode):  # type: ignore[misc, unused-ignore]
    """canopen's local node with our own storage behind its SDO server, and without its NMT slave."""

    def __init__(self, node_id: int, eds: str) -> None:
        super().__init__(node_id, eds)
        self.live: dict[int, Callable[[], float]] = {}
        self.hooks: dict[int, Callable[[int], None]] = {}
        self.float_hooks: dict[int, Callable[[float], None]] = {}
        self.values: dict[int, Value] = {}
        self._factory: dict[int, Value] = {}
        for entry in self.object_dictionary.values():
            variables = [entry] if isinstance(entry, ODVariable) else list(entry.values())
            for variable in variables:
                if variable.default is not None:
                    self._factory[key_of(variable.index, variable.subindex)] = variable.default

    def associate_network(self, network: canopen.Network) -> None:
        """Subscribe the SDO server only: NMT and EMCY are our own."""
        self.network = network
        self.sdo.network = network
        network.subscribe(self.sdo.rx_cobid, self.sdo.on_request)

    def set_default(self, index: int, subindex: int, value: Value) -> None:
        """Replace the default of the EDS."""
        self._factory[key_of(index, subindex)] = value

    def default(self, key: int) -> int:
        """Return the default of a numeric object."""
        value = self._factory.get(key, 0)
        return value if isinstance(value, int) else 0

    def restore(self, first: int = 0x1000, last: int = 0x9FFF) -> None:
        """Set stored objects to their defaults, through their hooks. The owners of live objects reset them."""
        for key, value in sorted(self._factory.items()):
            if first <= key >> 8 <= last and key not in self.live:
                hook = self.hooks.get(key)
                if hook is not None and isinstance(value, int):
                    hook(value)
                float_hook = self.float_hooks.get(key)
                if float_hook is not None and not isinstance(value, str):
                    float_hook(value)
                self.values[key] = value

    def number(self, key: int) -> float:
        """Return the present value of a numeric object."""
        live = self.live.get(key)
        if live is not None:
            return live()
        value = self.values[key]
        if isinstance(value, str):
            raise TypeError(f"object {key >> 8:04X}h:{key & 0xFF} is no number")
        return value

    def getter(self, key: int) -> Callable[[], float]:
        """Return the function that reads a numeric object at the fastest."""
        return self.live.get(key) or (lambda: self.number(key))

    def variable(self, index: int, subindex: int) -> ODVariable:
        """Return the object's description. Raises the SDO abort for a missing object."""
        found = self.object_dictionary.get(index)
        if found is None:
            raise SdoAbortedError(ABORT_NO_OBJECT)
        if isinstance(found, ODVariable):
            if subindex:
                raise SdoAbortedError(ABORT_NO_SUBINDEX)
            return found
        if subindex not in found.subindices:
            raise SdoAbortedError(ABORT_NO_SUBINDEX)
        return found.subindices[subindex]

    def mappable(self, entry: int, *, receives: bool) -> bool:
        """Return whether a mapping entry (index << 16 | subindex << 8 | bits) names an object that a PDO may carry."""
        variable = self.variable(entry >> 16, entry >> 8 & 0xFF)
        able = variable.pdo_mappable and (variable.writable if receives else variable.readable)
        return bool(able) and variable.data_type in FORMATS and entry & 0xFF == len(variable)

    def write(self, key: int, value: int) -> None:
        """Check a number against the limits and the hook, then store it. Raises an SDO abort with the reason."""
        variable = self.variable(key >> 8, key & 0xFF)
        if variable.min is not None and value < variable.min:
            raise SdoAbortedError(ABORT_TOO_LOW)
        if variable.max is not None and value > variable.max:
            raise SdoAbortedError(ABORT_TOO_HIGH)
        hook = self.hooks.get(key)
        if hook is not None:
            hook(value)
        self.values[key] = value

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:
        """Handle an SDO upload."""
        variable = self.variable(index, subindex)
        if check_readable and not variable.readable:
            raise SdoAbortedError(ABORT_READ_WRITE_ONLY)
        key = key_of(index, subindex)
        if key not in self.live and key not in self.values:
            raise SdoAbortedError(ABORT_NO_DATA)
        value: Value = self.live[key]() if key in self.live else self.values[key]
        return bytes(variable.encode_raw(value))

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
        """Handle an SDO download."""
        variable = self.variable(index, subindex)
        if check_writable and not variable.writable:
            raise SdoAbortedError(ABORT_WRITE_READ_ONLY)
        if variable.data_type == datatypes.VISIBLE_STRING:
            if len(data) > TEXT_LIMIT or not data.isascii():
                raise SdoAbortedError(ABORT_LENGTH)
            self.values[key_of(index, subindex)] = data.decode("ascii")
            return
        if 8 * len(data) != len(variable):
            raise SdoAbortedError(ABORT_LENGTH)
        if variable.data_type in objectdictionary.FLOAT_TYPES:
            number, key = float(variable.decode_raw(bytes(data))), key_of(index, subindex)
            if not isfinite(number):         # NaN and the infinities are out of every range
                raise SdoAbortedError(ABORT_VALUE)
            if key in self.float_hooks:
                self.float_hooks[key](number)
            self.values[key] = number
            return
        if variable.data_type not in objectdictionary.INTEGER_TYPES:
            raise SdoAbortedError(ABORT_LENGTH)
        value = variable.decode_raw(bytes(data))
        if not isinstance(value, int):
            raise SdoAbortedError(ABORT_LENGTH)
        self.write(key_of(index, subindex), value)

    def add(self, index: int, subindex: int, data_type: int, *, writable: bool, mappable: bool, name: str,
            default: Value | None = None) -> None:
        """Add an object, or replace one. Without a default its live getter is read."""
        variable = ODVariable(name, index, subindex)
        variable.data_type = data_type
        variable.access_type = "rw" if writable else "ro"
        variable.pdo_mappable = mappable
        known = self.object_dictionary.get(index)
        if subindex == 0 and not isinstance(known, ODRecord | ODArray):
            if known is not None:
                del self.object_dictionary[index]
            self.object_dictionary.add_object(variable)
        else:
            if not isinstance(known, ODRecord | ODArray):
                known = ODRecord(name, index)
                self.object_dictionary.add_object(known)
            known.add_member(variable)
        for table in (self.live, self.hooks, self.float_hooks, self.values, self._factory):
            table.pop(key_of(index, subindex), None)
        if default is not None:
            self.set_default(index, subindex, default)
            self.values[key_of(index, subindex)] = default

    def remove(self, index: int) -> None:
        """Remove an object with all its subindices: SDO then aborts with 06020000h."""
        if index not in self.object_dictionary:
            return
        del self.object_dictionary[index]
        for table in (self.live, self.hooks, self.float_hooks, self.values, self._factory):
            for key in [key for key in table if key >> 8 == index]:
                del table[key]
