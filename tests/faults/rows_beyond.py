"""What was found beyond the fifty by trying it on the rig floor, numbered on from 51, a section a room."""

from row import Row

LATE: dict[int, Row] = {
}

SECOND_MASTER: dict[int, Row] = {
}

MODBUS: dict[int, Row] = {
}

UNITS: dict[int, Row] = {
}

STAGES: dict[int, Row] = {
}

COMMAND_LINE: dict[int, Row] = {
}

LOG: dict[int, Row] = {
}

BEYOND = LATE | SECOND_MASTER | MODBUS | UNITS | STAGES | COMMAND_LINE | LOG
