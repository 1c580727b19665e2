"""One list for each kind of choice: a toy that is added to the list is available everywhere.

All code of a toy is in this file, and one line adds it. No other file of the tree changes.
"""

from __future__ import annotations

import ast
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

import tdhil
from drivers.errors import DataFileError
from profiles.model import Positive
from profiles.yaml_loader import parse_model
from sim_bus.params import RigParams
from sim_bus.plant import kinds as plants
from sim_bus.plant.friction.shaft import ShaftParams
from tdhil.cli.main import build_parser, main
from tdhil.config.registry import (
    BUSES,
    EXCITATIONS,
    MODELS,
    USUAL_STAGE_S,
    RegistryEntry,
    identified_before_echo,
    load,
    names,
)
from tdhil.config.rig import Registered, Rig, load_rig
from tdhil.errors import UsageError
from tdhil.estimation import Options, identify
from tdhil.estimation.frequency_domain.shafts import ShaftModel, TwoMassShaft
from tdhil.recording.csv.excitation import ExcitationFile
from tdhil.runner import STAGES
from tdhil.runner.excitation import (
    ExcitationKind,
    MotionLimits,
    PeriodicKind,
    PlanRefused,
    RigGuess,
    Shape,
    SpeedChange,
)
from tdhil.runner.excitation.pulses import SpeedChangeKind, SpeedChangePlan
from tdhil.runner.excitation.signals import unit_peak
from tdhil.runner.planning import adaptive, plan_acquisition, refuse_hopeless
from tdhil.runner.preconditions import refuse_by_plan
from tdhil.runner.settings import ExcitationRequest, MachineLimits
from tests.estimation.compliant_bench import TwoMass, run
from tests.estimation.test_two_mass import KNOWN as KNOWN_LAGS
from tests.estimation.test_two_mass import MILD
from tests.rigs import loaded_rig, rig_file
from tests.runner.test_design import KNOWN

ROOT = Path(__file__).parents[2]
LIMITS, GUESS = MotionLimits(0.5, 10.0, 400.0, 0.9), RigGuess(104.0, 8.0, 60.0)


# ---------------------------------------------------------------------------------------------------------------------
# An excitation: one file (its lines, or its ways), and one line in the list


def two_tones() -> Shape:
    return unit_peak(Shape(harmonics=(1, 3), amplitudes=(1.0, 0.4), phases_rad=(0.0, 1.0)))


def stairs(low: float, high: float, rate: float, guess: RigGuess) -> Iterator[SpeedChange]:
    levels = (low, 0.5 * (low + high), high, 0.5 * (low + high))
    number = 0
    while True:
        at, to = levels[number % 4], levels[(number + 1) % 4]
        yield SpeedChange(at, to, max(0.5, abs(to - at) / rate), guess)
        number += 1


TWO_TONES = PeriodicKind(shape=two_tones, frequency_hz=0.1)
STAIRS = SpeedChangeKind(ways=stairs, needs_torque_mode=True, why_torque_mode="for the test's sake", with_string=False)


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXCITATIONS, "two-tones", RegistryEntry(f"{__name__}:TWO_TONES", "two tones", periodic=True))
    monkeypatch.setitem(EXCITATIONS, "stairs", RegistryEntry(f"{__name__}:STAIRS", "up and down in steps"))


@pytest.mark.heavy
@pytest.mark.usefixtures("toys")
def test_a_toy_excitation_is_run_by_the_python_api_and_identified(tmp_path):
    with tdhil.simulate(seed=7) as drive:
        recording = tdhil.run(drive, tdhil.Motion("two-tones", periods=5), log=tmp_path / "run.mcap")
    excitation = recording.recording.excitation
    assert excitation is not None and excitation.kind == "two-tones"
    assert all(segment.lines_hz == pytest.approx((0.1, 0.3)) for segment in excitation.segments)
    inertia = tdhil.identify(recording).inertia
    assert inertia is not None and inertia.low < 104.0 < inertia.high


@pytest.mark.heavy
@pytest.mark.usefixtures("toys")
@pytest.mark.parametrize(("kind", "motion"), [("two-tones", "segments"), ("stairs", "ways")])
def test_a_toy_excitation_is_accepted_by_the_command_line_and_rig_yaml(kind, motion, tmp_path, capsys):
    rig = rig_file(tmp_path, f"run: {{excitation: {kind}}}\n")
    assert load_rig(rig).run.excitation == kind
    for words in (["--excitation", kind], ["--rig", str(rig)]):
        assert main(["identify", "--simulate", "--dry-run", "--json", *words]) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["excitation"] == kind and found[motion]


@pytest.mark.usefixtures("toys")
def test_the_properties_of_a_toy_excitation_are_used():
    assert adaptive(ExcitationRequest("two-tones", tolerance=0.01))
    assert not adaptive(ExcitationRequest("stairs", tolerance=0.01))
    planned = plan_acquisition(ExcitationRequest("stairs"), "torque", LIMITS, GUESS, KNOWN, math.inf)
    assert isinstance(planned.plan, SpeedChangePlan)
    with pytest.raises(PlanRefused, match="stairs needs a drive in torque mode: for the test's sake"):
        refuse_hopeless(ExcitationRequest("stairs"), ("speed",), LIMITS, GUESS, KNOWN)
    string = MachineLimits(0.5, 10.0, 400.0, 900.0, load="string", torque_ramp_nm_s=50.0)
    refuse_by_plan(string, ExcitationRequest("two-tones"), releases_after_stop=False)
    with pytest.raises(tdhil.TdhilError, match="stairs is not possible with a drill string"):
        refuse_by_plan(string, ExcitationRequest("stairs"), releases_after_stop=False)


@pytest.mark.usefixtures("toys")
def test_a_trace_may_have_a_periodic_toy_excitation():
    segment = "\nsegments: [{start_s: 0, periods: 3, period_s: 10, offset_rad_s: 2, lines_hz: [0.1, 0.3]}]\n"
    assert parse_model(f"kind: two-tones{segment}", "excitation.yaml", ExcitationFile).kind == "two-tones"
    with pytest.raises(DataFileError, match=r"'multisine', 'sine', 'step'.* or 'two-tones'"):
        parse_model(f"kind: stairs{segment}", "excitation.yaml", ExcitationFile)


# ---------------------------------------------------------------------------------------------------------------------
# A model of the shaft: its mechanics in its own file, and one line in the list


class StiffJoint(TwoMassShaft):
    """Two masses on a spring that a joint makes stiffer: a further shaft with its own name."""

    def scales(self, rough_inertia: float, s: Any) -> Any:
        return np.multiply(super().scales(rough_inertia, s), 1.0)


STIFF_JOINT = ShaftModel(StiffJoint, "a stiff joint")


@pytest.mark.heavy
def test_a_toy_shaft_is_fitted_by_name(monkeypatch):
    with pytest.raises(ValueError, match=r"model must be auto, rigid, two-mass, .* or [a-z-]+: 'stiff-joint'"):
        Options(model="stiff-joint")
    monkeypatch.setitem(MODELS, "stiff-joint", RegistryEntry(f"{__name__}:STIFF_JOINT", "a stiff joint"))
    recording = run(TwoMass(), [3], noise=MILD, lag_prior=KNOWN_LAGS)[0]
    toy, two = (identify(recording, Options(model=name)) for name in ("stiff-joint", "two-mass"))
    assert toy.model == "stiff-joint" and "a stiff joint explains the data" in toy.reason
    assert toy.inertia is not None and two.inertia is not None
    assert toy.inertia.value == pytest.approx(two.inertia.value)
    assert Rig.model_validate({"run": {"model": "stiff-joint"}}).run.model == "stiff-joint"
    for command in ("identify", "replay"):
        words = [command, *(["run.mcap"] if command == "replay" else []), "--model", "stiff-joint"]
        assert build_parser(command).parse_args(words).model == "stiff-joint"


# ---------------------------------------------------------------------------------------------------------------------
# A plant of the simulator: its file, and one line in the list


class FlywheelParams(ShaftParams):
    """Section of the toy in plant.yaml."""

    kind: Literal["flywheel"] = "flywheel"
    wheel_kg_m2: Positive = 10.0


class Flywheel(plants.Rigid):
    """Rigid shaft with additional inertia."""

    def __init__(self, params: FlywheelParams) -> None:
        same = {name: getattr(params, name) for name in ShaftParams.model_fields}
        super().__init__(plants.Params(**same | {"inertia_kg_m2": params.inertia_kg_m2 + params.wheel_kg_m2}))


def test_a_toy_plant_is_read_and_turned(monkeypatch):
    monkeypatch.setitem(plants.PLANTS, "flywheel", plants.PlantKind(FlywheelParams, Flywheel))
    text = "plant: {kind: flywheel, wheel_kg_m2: 900, coulomb_nm: 0, viscous_nm_s_rad: 0}\n"
    params = parse_model(text, "plant.yaml", RigParams).plant
    assert isinstance(params, FlywheelParams) and params.wheel_kg_m2 == 900.0
    plant = plants.build(params)
    turned = plant.step(plant.rest(), 100.0, 1.0)
    assert turned.speed_rad_s == pytest.approx(100.0 / (params.inertia_kg_m2 + 900.0))
    with pytest.raises(DataFileError, match=r"plant\.wheel_kg_m2: belongs to kind: flywheel, and this plant is rigid"):
        parse_model("plant: {wheel_kg_m2: 3}\n", "plant.yaml", RigParams)
    with pytest.raises(DataFileError, match=r"must be rigid, two_mass, .* or flywheel, not fly"):
        parse_model("plant: {kind: fly}\n", "plant.yaml", RigParams)
    with pytest.raises(DataFileError, match="wheel_kg_m2: must be greater than 0, not -1"):
        parse_model("plant: {kind: flywheel, wheel_kg_m2: -1.0}\n", "plant.yaml", RigParams)


# ---------------------------------------------------------------------------------------------------------------------
# The lists themselves


@pytest.mark.parametrize("registry", [EXCITATIONS, MODELS, BUSES], ids=["excitations", "models", "buses"])
def test_every_entry_stands_where_it_says(registry):
    assert all(load(registry, name) is not None and entry.text for name, entry in registry.items())


def test_every_excitation_is_what_its_entry_says():
    for name, entry in EXCITATIONS.items():
        kind = load(EXCITATIONS, name)
        assert isinstance(kind, ExcitationKind)
        assert isinstance(kind, PeriodicKind) == entry.periodic
        assert identified_before_echo(name) == entry.before_echo and not (entry.before_echo and kind.adaptive)
    assert not identified_before_echo("nobody's")


@pytest.mark.parametrize("registry", [EXCITATIONS, MODELS, BUSES], ids=["excitations", "models", "buses"])
@pytest.mark.parametrize("wrong", ["multisin", "", 3, None, ["sine"], {}, True])
def test_a_wrong_name_is_refused_like_a_literal(registry, wrong):
    ours = TypeAdapter(Annotated[str, Registered(registry)])
    theirs: TypeAdapter[Any] = TypeAdapter(Literal[tuple(registry)])    # type: ignore[valid-type]
    found = []
    for adapter in (ours, theirs):
        with pytest.raises(ValidationError) as caught:
            adapter.validate_python(wrong)
        found.append(caught.value.errors(include_url=False))
    assert found[0] == found[1]
    assert ours.json_schema()["enum"] == theirs.json_schema()["enum"] == names(registry)


def test_a_wrong_name_at_an_input_lists_the_choices(tmp_path, capsys):
    with pytest.raises(DataFileError, match=r"rig.yaml:2: run.excitation: must be 'multisine', .* or '[a-z-]+', "
                                            r"not the text 'multisin'; did you mean 'multisine'\?"):
        loaded_rig(tmp_path, "run:\n  excitation: multisin\n")
    wanted = r"^excitation: must be 'multisine', .* or '[a-z-]+', not"
    with tdhil.simulate(seed=7) as drive, pytest.raises(UsageError, match=wanted):
        tdhil.run(drive, tdhil.Motion("noise"), log=tmp_path / "run.mcap")
    assert main(["identify", "--excitation", "noise"]) == 2
    said = capsys.readouterr().err
    assert "invalid choice: 'noise'" in said and all(name in said.rpartition("choose from")[2] for name in EXCITATIONS)


@pytest.mark.heavy
def test_no_chain_of_excitations_or_models_is_left():
    chains = []
    for path in sorted((ROOT / "tdhil").rglob("*.py")):
        if "studies" in path.parts:     # the signals of the paper, independent of those of a run
            continue
        apart = set(EXCITATIONS) | (set(MODELS) if "estimation" in path.parts else set())
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Compare | ast.MatchValue | ast.MatchOr):
                told = {one.value for one in ast.walk(node) if isinstance(one, ast.Constant)
                        and isinstance(one.value, str)} & apart
                chains += [f"{path.relative_to(ROOT)}:{node.lineno}: {name}" for name in told]
    assert chains == []


def test_the_usual_durations_are_those_of_the_stages_and_in_one_place():
    assert tuple(USUAL_STAGE_S) == STAGES
    again = re.compile(r'"setup": [\d.]+, *"speed": [\d.]+')
    assert [path.name for path in (ROOT / "tdhil").rglob("*.py") if again.search(path.read_text("utf-8"))] == [
        "registry.py"]
