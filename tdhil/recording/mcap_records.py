"""Records of an MCAP container, as the readers of a log need them: heads and opcodes.

::

    opcode:1  length:8  body                                            each record
    channel:2  sequence:4  log time:8  publish time:8  payload          body of a message
"""

from struct import Struct
from typing import Final

from mcap.opcode import Opcode

RECORD_HEAD: Final = Struct("<BQ")
MESSAGE_HEAD: Final = Struct("<HIQQ")

HEADER: Final = int(Opcode.HEADER)
FOOTER: Final = int(Opcode.FOOTER)
SCHEMA: Final = int(Opcode.SCHEMA)
CHANNEL: Final = int(Opcode.CHANNEL)
MESSAGE: Final = int(Opcode.MESSAGE)
CHUNK: Final = int(Opcode.CHUNK)
MESSAGE_INDEX: Final = int(Opcode.MESSAGE_INDEX)
CHUNK_INDEX: Final = int(Opcode.CHUNK_INDEX)
ATTACHMENT: Final = int(Opcode.ATTACHMENT)
STATISTICS: Final = int(Opcode.STATISTICS)
METADATA: Final = int(Opcode.METADATA)
SUMMARY_OFFSET: Final = int(Opcode.SUMMARY_OFFSET)
DATA_END: Final = int(Opcode.DATA_END)
KNOWN: Final = frozenset(int(one) for one in Opcode)
