"""Examples: they load and are complete, and the page on rig.yaml has every key."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from profiles.yaml_loader import load_with_lines
from sim_bus.params import RigParams
from sim_bus.params import load_rig as load_plant
from tdhil.config.options import OPTIONS
from tdhil.config.rig import load_rig, require_limits, rig_model

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "rig.yaml"
MODBUS = ROOT / "examples" / "rig_modbus.yaml"
ETHERCAT = ROOT / "examples" / "rig_ethercat.yaml"
PLANT = ROOT / "examples" / "plant.yaml"


def keys(model: type[BaseModel], prefix: str = "") -> dict[str, Any]:
    """Return dotted key → default; `PydanticUndefined` if the key is required."""
    found: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        key = prefix + (field.alias or name)
        inner = next((part for part in (field.annotation, *getattr(field.annotation, "__args__", ()))
                      if isinstance(part, type) and issubclass(part, BaseModel)), None)
        found |= keys(inner, f"{key}.") if inner else {key: field.default}
    return found


def rows() -> dict[str, list[str]]:
    text = (ROOT / "docs" / "reference" / "rig.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `([a-z_.0-9]+)` \| (.*) \|$", text, re.MULTILINE)
    assert len(found) == len({key for key, _ in found})
    return {key: [cell.strip() for cell in rest.split(" | ")] for key, rest in found}


def test_rig_example_is_a_bench_that_may_move():
    rig = load_rig(EXAMPLE)
    require_limits(rig)
    assert rig.bus.interface == "socketcan"
    assert rig.run.simulate is None


def test_modbus_example_is_a_bench_that_may_move():
    rig = load_rig(MODBUS)
    require_limits(rig)
    assert (rig.drive, rig.modbus.host, rig.modbus.serial) == ("modbus", "192.0.2.10", None)


def test_ethercat_example_is_a_bench_that_may_move():
    rig = load_rig(ETHERCAT)
    require_limits(rig)
    assert (rig.drive, rig.ethercat.interface, rig.ethercat.position) == ("ethercat", "eth1", 0)


def test_modbus_example_is_valid_on_a_serial_line_too(tmp_path):
    text = MODBUS.read_text(encoding="utf-8")
    text = re.sub(r"^# (serial|baud|parity|stop_bits|parameters):", r"  \1:", text, flags=re.MULTILINE)
    text = re.sub(r"^# (accept_unverified):", r"\1:", text, flags=re.MULTILINE)
    path = tmp_path / "rig.yaml"
    path.write_text(re.sub(r"^  (host|port):.*\n", "", text, flags=re.MULTILINE), encoding="utf-8")
    rig = load_rig(path)
    assert (rig.modbus.serial, rig.modbus.baud, rig.modbus.parity) == ("/dev/ttyUSB0", 115200, "E")
    assert rig.accept_unverified == ("watchdog",)
    assert rig.drive_data.parameters == {"speed_scaling": 1500}


def test_the_examples_show_every_key_but_those_for_trying_things_out():
    text = "".join(path.read_text(encoding="utf-8") for path in (EXAMPLE, ETHERCAT, MODBUS))
    missing = {key for key in keys(rig_model()) if not re.search(rf"^[# ]*{key.split('.')[-1]}:", text, re.MULTILINE)}
    assert missing == {"bus.options", "run.mode", "run.frequency_hz", "run.amplitude_rad_s", "run.offset_rad_s",
                       "run.periods", "run.realisations", "run.seed", "run.simulate", "run.real_time", "run.stepped",
                       "run.json", "run.plant", "run.trace", "run.simulated_torque_scale",
                       "run.simulated_speed_scale", "run.simulated_added_inertia_kg_m2"}


def test_rig_example_is_valid_with_its_commented_keys_too(tmp_path):
    text = re.sub(r"^# ?( *[a-z_0-9]+: +[0-9].*)$", lambda found: _indented(found[1]), EXAMPLE.read_text("utf-8"),
                  flags=re.MULTILINE)
    path = tmp_path / "rig.yaml"
    path.write_text(text.replace("kind: none", "kind: string"), encoding="utf-8")
    rig = load_rig(path)
    assert (rig.make_up_torque_nm, rig.load.length_m) == (9000, 2300)
    assert rig.drive_data.torque_lag_sd_s == 0.01


def _indented(line: str) -> str:
    inside = ("lag", "filter", "temperature", "length", "diameter", "tolerance", "calibration")
    return ("  " if any(word in line for word in inside) else "") + line


def test_plant_example_is_the_default_rig_and_complete():
    assert load_plant(PLANT) == RigParams()
    lines = load_with_lines(PLANT, RigParams).lines
    missing = set(keys(RigParams)) - {".".join(map(str, path)) for path in lines}
    assert all(key.startswith("plant.harmonics.") for key in missing)      # a list, empty by default: its comment
    assert all(f"{key.rpartition('.')[2]}:" in PLANT.read_text(encoding="utf-8") for key in missing)


def test_page_has_every_key_and_no_other():
    assert set(rows()) == set(keys(rig_model()))


@pytest.mark.parametrize("key", sorted(keys(rig_model())))
def test_page_states_the_true_default(key):
    default = keys(rig_model())[key]
    shown = rows()[key][0]
    built_in = next((option.default for option in OPTIONS if option.at == key), None)
    if default is PydanticUndefined:
        assert shown == "needed"
    elif default is not None or built_in is not None:
        value = built_in if default is None else default
        assert shown == (str(value).lower() if isinstance(value, bool) else str(value))
    else:
        assert not re.match(r"[0-9]", shown)


@pytest.mark.parametrize("option", [option for option in OPTIONS if option.at], ids=lambda option: option.flag)
def test_page_names_the_option(option):
    assert f"`{option.flag}`" in rows()[option.at][1]
