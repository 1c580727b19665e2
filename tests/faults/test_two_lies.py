"""Two false reports at once, before stage 2 ends: each run is compared with the true shaft."""

import pytest

from sim_bus.lying_runs import PROGRAMS
from sim_bus.shaft_judge import JudgedMachine, judge, outcome_of, read_shaft
from tests.faults.test_lying_reports import closed
from tests.path.path_runs import tdhil

SWAPPED_AND_FROZEN = ("speed-swapped@setup+2.79s", "sensor-frozen@setup+4.39s")
"""The reported speed is the count of the torque, and the drive's speed control follows a frozen sensor.

Speed control then drives the shaft with the full torque, and so does its quick stop, to 42 rad/s at a limit of 10."""


@pytest.mark.heavy(but_first=1)
@pytest.mark.parametrize("name", ["impedance", "identify", "identify, Modbus", "identify, no position",
                                  "virtual string"])
def test_two_lies_do_not_drive_the_shaft(name, tmp_path):
    program = PROGRAMS[name]
    for file, text in program.files.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    log, trace = tmp_path / "run.mcap", tmp_path / "shaft.csv"
    arguments = [one.replace("{folder}", str(tmp_path)) for one in program.arguments]
    faults = [part for fault in SWAPPED_AND_FROZEN for part in ("--fault", fault)]
    done = tdhil(*arguments, "--seed", 1, *faults, "--json", "--log", log, "--trace", trace)
    outcome = outcome_of(done.code, done.document, done.err, log_closed=closed(log))
    machine = JudgedMachine(program.inertia_kg_m2, program.coulomb_nm, program.torque_nm, program.speed_max_rad_s,
                            program.string)
    assert judge(read_shaft(trace), outcome, machine).broken == {}, outcome.message
