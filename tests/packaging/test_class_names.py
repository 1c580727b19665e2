"""Unique class names: no two classes of the source have the same name, except for those with the same meaning.

A leading underscore does not make a different name: a search finds both ``_Point`` and ``Point``.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = ("tdhil", "drivers", "sim_bus", "profiles")

# Names of several classes, their places, and the reason for one name.
SHARED = {
    "Check": ({"drivers/drive.py", "tdhil/service/run_state.py"},
              "one line of the preflight table: as the driver makes it, and as the service's document names it"),
    "DrillString": ({"tdhil/soft_torque/drill_string.py", "sim_bus/plant/drill_string.py"},
                    "the same string, written twice on purpose: the simulator shares no physics with what it proves"),
    "Cyclic": ({"profiles/canopen.py", "profiles/ethercat.py"}, "the same section of a profile, on either bus"),
    "Faults": ({"sim_bus/canopen/faults.py", "sim_bus/ethercat/faults.py", "sim_bus/modbus/faults.py"},
               "the script of one drive, on any bus"),
    "Misbehaviour": ({"sim_bus/canopen/faults.py", "sim_bus/modbus/faults.py"},
                     "what a fault of the bus in question overrides"),
    "Parameter": ({"profiles/cia402.py", "profiles/modbus.py"}, "the same section of a profile, on either bus"),
    "Position": ({"profiles/cia402.py", "profiles/modbus.py"}, "the same section of a profile, on either bus"),
    "QuickStop": ({"profiles/cia402.py", "profiles/modbus.py"}, "the same section of a profile, on either bus"),
    "Scene": ({"sim_bus/canopen/faults.py", "sim_bus/modbus/faults.py"}, "where a fault happens, on either bus"),
    "Simulator": ({"sim_bus/canopen/simulator.py", "sim_bus/ethercat/simulator.py"},
                  "the simulated drive with its time, on either bus"),
    "State": ({"drivers/cia402/state_machine.py", "sim_bus/cia402.py", "tdhil/service/run_state.py"},
              "the states of CiA 402, which driver and simulator each take from the standard; and those of a run, as "
              "the service's document names them"),
    "Watchdog": ({"profiles/canopen.py", "profiles/ethercat.py"}, "the same section of a profile, on either bus"),
}


@pytest.mark.heavy(each_share=True)
def test_no_two_classes_have_one_name():
    found = defaultdict(list)
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            if "class " in source:
                for node in ast.walk(ast.parse(source)):
                    if isinstance(node, ast.ClassDef):
                        found[node.name.lstrip("_")].append(path.relative_to(ROOT).as_posix())
    twice = {name: sorted(paths) for name, paths in found.items() if len(paths) > 1}
    assert len(found) > 800
    assert twice == {name: sorted(paths) for name, (paths, _) in SHARED.items()}
