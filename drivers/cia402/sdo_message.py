"""SDO messages (CiA 301): requests, and what an answer to one of them holds. Pure.

A frame of CANopen and a mailbox message of EtherCAT (CoE) carry them alike. CoE also has a normal transfer: the data
follow the first eight bytes.

::

    command u8, index u16, sub-index u8, four bytes of data or the length [, data]
"""

UPLOAD, UPLOAD_SEGMENT, ABORT = 0x40, 0x60, 0x80
TOGGLE = 0x10
_ANSWERS = {0: 1, 1: 3, 2: 2, 3: 0}
"""Command specifier of the request → that of its response: segment and initiate, download and upload."""
_INITIATE = (1, 2)
_UPLOADED = 2
_ABORTS = {
    0x05030000: "SDO toggle bit error",
    0x05040000: "Timeout of transfer communication detected",
    0x05040001: "Unknown SDO command specified",
    0x05040002: "Invalid block size",
    0x05040003: "Invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "Out of memory",
    0x06010000: "Unsupported access to an object",
    0x06010001: "Attempt to read a write only object",
    0x06010002: "Attempt to write a read only object",
    0x06020000: "Object does not exist",
    0x06040041: "Object cannot be mapped to the PDO",
    0x06040042: "PDO length exceeded",
    0x06040043: "General parameter incompatibility reason",
    0x06040047: "General internal incompatibility in the device",
    0x06060000: "Access failed due to a hardware error",
    0x06070010: "Data type and length code do not match",
    0x06070012: "Data type does not match, length of service parameter too high",
    0x06070013: "Data type does not match, length of service parameter too low",
    0x06090011: "Subindex does not exist",
    0x06090030: "Value range of parameter exceeded",
    0x06090031: "Value of parameter written too high",
    0x06090032: "Value of parameter written too low",
    0x06090036: "Maximum value is less than minimum value",
    0x060A0023: "Resource not available",
    0x08000000: "General error",
    0x08000020: "Data cannot be transferred or stored to the application",
    0x08000021: "Data can not be transferred or stored to the application because of local control",
    0x08000022: "Data can not be transferred or stored to the application because of the present device state",
    0x08000023: "Object dictionary dynamic generation fails or no object dictionary is present",
    0x08000024: "No data available",
}


def upload(index: int, sub: int) -> bytes:
    """Return the request to read an object."""
    return bytes((UPLOAD, index & 0xFF, index >> 8, sub, 0, 0, 0, 0))


def download(index: int, sub: int, data: bytes) -> bytes:
    """Return the request to write an object: expedited up to four bytes, else normal."""
    place = bytes((index & 0xFF, index >> 8, sub))
    if 0 < len(data) <= 4:
        return bytes((0x23 | 4 - len(data) << 2,)) + place + data.ljust(4, b"\0")
    return b"\x21" + place + len(data).to_bytes(4, "little") + data


def abort_text(code: int) -> str:
    """Return an abort code with its meaning (CiA 301)."""
    return f"Code 0x{code:08X}" + (f", {_ABORTS[code]}" if code in _ABORTS else "")


def is_answer(request: bytes, response: bytes) -> bool:
    """Return whether eight bytes answer the request. Late answers and answers to other clients do not."""
    if len(response) != 8:
        return False
    command = request[0] >> 5
    same_object = response[1:4] == request[1:4]
    if response[0] == ABORT:
        return same_object or command not in _INITIATE
    if response[0] >> 5 != _ANSWERS.get(command):
        return False
    return same_object if command in _INITIATE else not (request[0] ^ response[0]) & TOGGLE


def value_of(answer: bytes) -> bytes:
    """Return the data in the first answer to an upload."""
    if not answer[0] & 2:
        return answer[8 : 8 + int.from_bytes(answer[4:8], "little")]
    return answer[4 : 8 - (answer[0] >> 2 & 3 if answer[0] & 1 else 0)]


def uploaded(message: bytes) -> tuple[int, int, bytes | None] | None:
    """Return index, sub-index and data of an answer to an upload; data None: refused.

    None for other messages, and for an answer whose data come in segments.
    """
    if len(message) < 8 or message[0] >> 5 not in (_UPLOADED, ABORT >> 5):
        return None
    data = None if message[0] == ABORT else value_of(message)
    return None if data == b"" else (int.from_bytes(message[1:3], "little"), message[3], data)
