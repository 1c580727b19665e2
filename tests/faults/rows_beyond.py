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
    95: Row("rig.yaml confirms in the operator's place (run: yes, accept_no_watchdog …)", "refused, with the line and "
            "the flag; consent to a profile's entries counts for the profile of the same file only", "2",
            ("tests/tdhil/test_only_the_operator.py::test_a_file_does_not_confirm",
             "tests/tdhil/test_only_the_operator.py::test_nothing_that_the_operator_answers_for_stands_in_a_file",
             "tests/tdhil/test_only_the_operator.py::test_consent_in_a_file_is_for_the_profile_of_that_file"),
            "the key is named with its line, nothing is connected to"),
}

LOG: dict[int, Row] = {
}

BEYOND = LATE | SECOND_MASTER | MODBUS | UNITS | STAGES | COMMAND_LINE | LOG
