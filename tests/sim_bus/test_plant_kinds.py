"""plant.yaml: every kind loads, reports errors, is documented, and turns with the CANopen interface."""

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from profiles.errors import DataFileError
from profiles.yaml_loader import parse_model
from sim_bus.cia402 import Application
from sim_bus.inverter import Inverter
from sim_bus.params import FAITHFUL, QUIET, DriveParams, NoiseParams, RigParams, load_rig
from sim_bus.plant.drill_string import StringParams
from sim_bus.plant.kinds import PLANTS, build
from sim_bus.plant.rigid import Params
from sim_bus.plant.two_mass import Bottom, TwoMassParams

ROOT = Path(__file__).parents[2]
KINDS = {"plant.yaml": Params, "plant_two_mass.yaml": TwoMassParams, "plant_string.yaml": StringParams,
         "plant_stick_slip.yaml": StringParams, "plant_top_drive.yaml": Params}


def defaults(model: type[BaseModel], prefix: str = "") -> dict[str, set[Any]]:
    """Return dotted key → its defaults; several if the kinds of plant differ."""
    found: dict[str, set[Any]] = {}
    for name, field in model.model_fields.items():
        parts = [part for part in (field.annotation, *get_args(field.annotation))
                 if isinstance(part, type) and issubclass(part, BaseModel)]
        for part in parts:
            for key, values in defaults(part, f"{prefix}{name}.").items():
                found.setdefault(key, set()).update(values)
        if not parts:
            found.setdefault(prefix + name, set()).add(field.default)
    return found


DEFAULTS = defaults(RigParams) | {"plant.kind": {"rigid"}}
FRICTIONS = get_args(Params.model_fields["friction"].annotation)
UNITS = {"_kg_m2": "kg·m²", "_nm_s_rad": "N·m·s/rad", "_nm_rad": "N·m/rad", "_nm": "N·m", "_rad_s": "rad/s",
         "_rad_s2": "rad/s²", "_rad": "rad", "_m": "m", "_pa": "Pa", "_kg_m3": "kg/m³",
         "_nm_s_rad_m": "N·m·s/rad per m", "_a": "A", "_rpm": "1/min", "_s": "s", "_permille": "‰"}


def rows() -> dict[str, tuple[str, str]]:
    text = (ROOT / "docs" / "reference" / "plant.md").read_text(encoding="utf-8")
    found = re.findall(r"^\| `([a-z_.0-9]+\.[a-z_.0-9]+)` \| ([^|]*) \| ([^|]*) \| .+ \|$", text, re.MULTILINE)
    assert len(found) == len({key for key, *_ in found})
    return {key: (unit, default) for key, unit, default in found}


def test_page_has_every_key_and_no_other() -> None:
    assert set(rows()) == set(DEFAULTS)


@pytest.mark.parametrize("key", sorted(DEFAULTS))
def test_page_says_the_true_default_and_unit(key: str) -> None:
    unit, shown = rows()[key]
    assert shown.split(" or ") == sorted((str(value) for value in DEFAULTS[key]), key=len)
    ending = max((end for end in UNITS if key.endswith(end)), key=len, default=None)
    assert unit == (UNITS[ending] if ending and key != "plant.bottom_end" else "–")


@pytest.mark.parametrize("name", KINDS)
def test_examples_load_and_move(name: str) -> None:
    rig = load_rig(ROOT / "examples" / name)
    assert type(rig.plant) is KINDS[name]
    drive = Inverter(rig, np.random.default_rng(1))
    drive.control.speed(4.0, 1.0, 1.0)
    for _ in range(5000):
        drive.step(0.002)
    assert drive.speed_rad_s == pytest.approx(4.0, abs=1.0)


def test_no_example_is_missing_here() -> None:
    assert {path.name for path in (ROOT / "examples").glob("plant*.yaml")} == set(KINDS)


def test_a_file_without_a_kind_is_rigid() -> None:
    rig = parse_model("plant:\n  inertia_kg_m2: 50\n  friction: dahl\n", "plant.yaml", RigParams)
    assert rig.plant == Params(inertia_kg_m2=50.0, friction="dahl")
    assert RigParams(plant={"coulomb_nm": 0.0}).plant == Params(coulomb_nm=0.0)  # type: ignore[arg-type]


@pytest.mark.parametrize(("text", "says"), [
    ("kind: twomass", f"plant.kind: must be {', '.join([*PLANTS][:-1])} or {[*PLANTS][-1]}, not twomass"),
    ("kind: [two_mass]", ", not a list or section"),
    ("stiffness_nm_rad: 3", "plant.stiffness_nm_rad: belongs to kind: two_mass, and this plant is rigid"),
    ("kind: string\n  damping_nm_s_rad: 3", "plant.damping_nm_s_rad: belongs to kind: two_mass, and this plant is"),
    ("bottom: {coulomb_nm: 3}", "plant.bottom: belongs to kind: two_mass or string, and this plant is rigid"),
    ("kind: two_mass\n  stiffnes_nm_rad: 3", "unknown key 'stiffnes_nm_rad'; did you mean 'stiffness_nm_rad'?"),
    ("kind: two_mass\n  bottom:\n    friction: lugr",
     f"plant.bottom.friction: must be {', '.join(map(repr, FRICTIONS[:-1]))} or {FRICTIONS[-1]!r}, not"),
    ("friction: stribeck\n  static_nm: 10", "plant.static_nm: breakaway torque can't be below coulomb_nm (60)"),
    ("kind: string\n  length_m: 1", "plant.length_m: waves would take"),
])
def test_errors_are_reported_at_their_line(text: str, says: str) -> None:
    with pytest.raises(DataFileError) as caught:
        parse_model(f"plant:\n  {text}\n", "plant.yaml", RigParams)
    assert says in str(caught.value)
    assert f"plant.yaml:{2 + text.count(chr(10))}:" in str(caught.value)


@pytest.mark.parametrize("params", [Params(), TwoMassParams(), StringParams()], ids=lambda params: params.kind)
def test_every_plant_keeps_the_one_protocol(params: Any) -> None:
    plant = build(params)
    state = plant.rest()
    assert (state.speed_rad_s, state.angle_rad) == (0.0, 0.0)
    assert plant.step(state, params.coulomb_nm, 0.002, 0.0).speed_rad_s == 0.0
    loaded, free = plant.step(state, 300.0, 0.002, 100.0), plant.step(state, 200.0, 0.002, 0.0)
    assert loaded.speed_rad_s == free.speed_rad_s > 0.0
    assert plant.step(free, 0.0, 0.002, 0.0).angle_rad == plant.step(free, 0.0, 0.002, 0.0).angle_rad > 0.0


@pytest.mark.heavy
def test_two_masses_turn_with_the_canopen_interface(bench: Callable[..., Any], tmp_path: Path) -> None:
    """The trace in speed mode shows the shaft of the motor, not that of the bottom."""
    drive = DriveParams(rated_torque_nm=10_000.0, torque_limit_nm=8000.0, speed_gain_nm_s_rad=3000.0,
                        speed_integral_gain_nm_rad=2000.0)
    rig = RigParams(plant=TwoMassParams(), noise=QUIET, reporting=FAITHFUL, drive=drive)
    simulated, host = bench(rig, trace=tmp_path / "trace.csv")
    host.set_up()
    host.enable()
    motor, bottom, reported = [0.0], [0.0], []
    for _ in range(2000):
        reported.append(host.cycle(velocity=300)[2] * 2.0 * np.pi / 600.0)
        host.read(0x1000)                                     # the reply comes after the step: no motion in between
        state = simulated.simulator.node.inverter.state
        motor.append(state.speed_rad_s)
        bottom.append(state.bottom_speed_rad_s)
    assert motor[-1] == pytest.approx(np.pi, rel=0.05)
    assert np.max(np.abs(np.subtract(motor, bottom))) > 1.0           # the run-up twists the string
    assert np.allclose(reported[1:], motor[1:-1], atol=0.02)          # SYNC samples, then time advances
    simulated.close()
    with (tmp_path / "trace.csv").open(encoding="utf-8") as stream:
        traced = [float(row["speed_rad_s"]) for row in csv.DictReader(stream) if not row["event"]]
    assert np.allclose(traced[-2000:], motor[1:], rtol=1e-5, atol=1e-7)

def test_a_load_at_the_bottom_affects_the_motor_after_one_travel_time() -> None:
    """Two masses move according to the spring. Before the wave arrives, the motor moves as without the load."""
    params = StringParams(length_m=500.0, drag_nm_s_rad_m=0.0, coulomb_nm=0.0, bottom=Bottom(coulomb_nm=0.0))
    plant = build(params)
    calm = loaded = plant.rest()
    first = None
    for step in range(400):
        calm, loaded = plant.step(calm, 500.0, 0.001), plant.step(loaded, 500.0, 0.001, 0.0, 300.0)
        if first is None and calm.speed_rad_s != loaded.speed_rad_s:
            first = 0.001 * step
    assert first == pytest.approx(params.delay_s, abs=0.006)
    assert loaded.speed_rad_s < calm.speed_rad_s
    two = build(TwoMassParams(coulomb_nm=0.0, bottom=Bottom(coulomb_nm=0.0, viscous_nm_s_rad=0.0)))
    state = two.rest()
    for _ in range(10):
        state = two.step(state, 0.0, 0.002, 0.0, 300.0)
    assert state.bottom_speed_rad_s == pytest.approx(-300.0 * 0.02 / 374.0, rel=0.01)


def test_a_drive_has_the_quick_stop_that_was_set_at_it() -> None:
    rig = RigParams.model_validate({"drive": {"quick_stop_rad_s2": 39.1}})
    assert Application(Inverter(rig, np.random.default_rng(1))).settings.quick_stop_rad_s2 == 39.1


def test_a_rigid_shaft_has_no_bottom_to_be_loaded() -> None:
    with pytest.raises(ValidationError, match="needs a plant with a bottom"):
        RigParams(noise=NoiseParams(bottom_load_nm=10.0))


def test_what_disturbs_the_motor_is_the_same_with_a_load_at_the_bottom() -> None:
    plant = StringParams()
    with_one, without = (
        Inverter(RigParams(plant=plant, noise=NoiseParams(bottom_load_nm=load)), np.random.default_rng(3))
        for load in (50.0, 0.0)
    )
    for one in (with_one, without):
        one.state = one.state._replace(bottom_speed_rad_s=5.0)
    for _ in range(50):                  # before a wave from the bottom arrives
        with_one.step(0.002)
        without.step(0.002)
    assert with_one.speed_rad_s == without.speed_rad_s
    assert with_one.state.bottom_speed_rad_s != without.state.bottom_speed_rad_s


def test_a_bit_at_standstill_does_not_excite_the_string() -> None:
    """The random load of a bit comes from cutting. With a string at standstill the motor has no torque."""
    drive = Inverter(RigParams(plant=StringParams(), noise=NoiseParams(bottom_load_nm=500.0, load_nm=0.0)),
                     np.random.default_rng(3))
    for _ in range(1000):
        drive.step(0.002)
    assert drive.state.bottom_speed_rad_s == drive.speed_rad_s == 0.0
