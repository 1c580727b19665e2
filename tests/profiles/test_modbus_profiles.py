"""Shipped Modbus profiles: required entries, and messages for wrong ones."""

from functools import cache
from pathlib import Path

import pytest

from profiles.errors import DataFileError, UsageError
from profiles.library import load_modbus_profile, profile_names, profile_path
from profiles.modbus import ModbusProfile, Register

NAMES = (
    "abb/acs880-classic", "abb/acs880-enhanced", "danfoss/fc302", "delta/ms300", "generic/modbus", "lenze/i550",
    "schneider/atv320", "schneider/atv340-930", "siemens/g120", "siemens/g130-s120", "yaskawa/ga700",
)
SPEED_ONLY = {"danfoss/fc302", "delta/ms300", "lenze/i550", "schneider/atv320"}

worn = cache(load_modbus_profile)


def text_of(name: str) -> str:
    return Path(profile_path(name)).read_text(encoding="utf-8")


def places(profile: ModbusProfile) -> list[tuple[str, Register]]:
    """Return every register with its meaning; that of the mode is omitted if another entry rightly uses it."""
    cycle = profile.cycle
    found = [(f"cycle.{name}", getattr(cycle, name).register_)
             for name in ("control", "status", "speed_setpoint", "torque_setpoint", "speed", "torque", "torque_demand")
             if getattr(cycle, name) is not None]
    found += [("modes", profile.modes.register_)] if profile.modes.register_ is not None else []
    found += [("modes.display", profile.modes.display.register_)] if profile.modes.display is not None else []
    found += [(f"parameters.{one.name}", one.register_) for one in profile.parameters if one.register_ is not None]
    found += [(f"echoes.{one.setpoint}", one.register_) for one in profile.echoes]
    return found


def test_all_promised_profiles_are_shipped() -> None:
    assert set(NAMES) <= set(profile_names())


@pytest.mark.parametrize("name", NAMES)
def test_it_loads_under_its_own_name_with_modes_as_promised(name: str) -> None:
    profile = worn(name)
    assert profile.name == name
    assert profile.modes.torque is (name not in SPEED_ONLY)
    assert profile.experimental is (name == "schneider/atv340-930")


@pytest.mark.parametrize("name", NAMES)
def test_no_two_meanings_in_one_register(name: str) -> None:
    taken: dict[tuple[str, int], str] = {}
    for what, register in places(worn(name)):
        for address in range(register.address, register.address + register.count):
            assert address <= 0xFFFF, what
            assert taken.setdefault((register.table, address), what) == what


@pytest.mark.parametrize("name", NAMES)
def test_the_functions_reach_every_register_of_the_cycle(name: str) -> None:
    profile = worn(name)
    functions = set(profile.cycle.functions)
    for what, register in places(profile):
        assert (3 if register.table == "holding" else 4) in functions, what
        assert register.count <= profile.cycle.largest_read
        if register.count == 2:
            assert functions & {16, 23}, what          # otherwise its halves would act one after the other
    assert functions & {6, 16, 23}
    written = [getattr(profile.cycle, one).register_ for one in ("control", "speed_setpoint")]
    assert all(register.table == "holding" for register in written)


@pytest.mark.parametrize("name", NAMES)
def test_sources_are_stated(name: str) -> None:
    for entry, part in worn(name).entries():
        assert len(part.source) > 5, entry
        # A source of second-hand knowledge must not be marked as verified.
        assert part.confidence != "verified" or "from memory" not in part.source, entry
        assert "facts.md" not in part.source


@pytest.mark.parametrize("name", NAMES)
def test_the_words_lead_from_off_to_enabled_and_each_word_is_one_request(name: str) -> None:
    control = worn(name).control
    onward = {state.means: state.onward for state in control.states if state.onward is not None}
    assert {"off", "enabled"} <= set(onward)
    ends = ("fault", "fault_reaction", "quick_stop")
    assert all(state.onward is None for state in control.states if state.means in ends)
    enabled = next(state.onward for state in control.states if state.means == "enabled")
    assert enabled not in (control.off, control.quick_stop)
    assert control.torque_bits == 0 or not control.torque_bits & control.speed_bits


@pytest.mark.parametrize("name", NAMES)
def test_each_state_can_be_decoded(name: str) -> None:
    """An earlier state in the list must not mask a later one."""
    states = worn(name).control.states
    for number, state in enumerate(states):
        words = range(0x1_0000)
        first = next(
            (word for word in words if word & state.mask == state.value
             and all(word & before.mask != before.value for before in states[:number])), None
        )
        assert first is not None, state


@pytest.mark.parametrize("name", NAMES)
def test_every_profile_has_a_watchdog(name: str) -> None:
    profile = worn(name)
    watchdog = profile.watchdog
    assert watchdog.kind == "timeout"
    assert watchdog.parameter is not None
    time_out = profile.parameter(watchdog.parameter)
    assert time_out.unit == "s"
    # A read value must be above zero, which is off on all these drives; a written value is above zero.
    assert time_out.set_to == "watchdog" or (time_out.require is not None and (time_out.require.at_least or 0.0) > 0.0)
    if watchdog.reaction_parameter is not None:
        assert profile.parameter(watchdog.reaction_parameter).require is not None


@pytest.mark.parametrize("name", NAMES)
def test_manual_settings_have_instructions(name: str) -> None:
    own_map = name == "generic/modbus"
    for parameter in worn(name).parameters:
        if parameter.require is not None and not own_map:
            assert parameter.advice, parameter.name
        if parameter.register_ is None:
            assert parameter.advice, parameter.name


@pytest.mark.parametrize("name", NAMES)
def test_the_file_begins_with_its_particulars(name: str) -> None:
    head = text_of(name).split("\nname:")[0]
    assert head.startswith("#")
    if name != "generic/modbus":
        assert all(f"# {word}" in head for word in ("Special:", "To set:", "Unsure:"))


@pytest.mark.heavy(but_first=4)
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("family: profidrive", "family: profibus", "family"),
        ("confidence: verified", "confidence: sure", "must be 'verified', 'likely' or 'unverified', not"),
        ("times: reference_torque", "times: reference_tork", "no parameter 'reference_tork'"),
        ("parameter: monitoring_time", "parameter: p2040", "no parameter 'p2040'"),
        ("torque: true", "torque: false", "none where torque is false"),
        ("by: register", "by: control_bits", "belong to by: register"),
        ("speed_value: 0", "speed_valve: 0", "speed_valve"),
        ("address: 99,", "address: 70000,", "65535"),
        ("per_lsb: 0.00006103515625", "per_lsb: 0", "greater than 0"),
        ("means: fault", "means: failure", "failure"),
        ("require: {equals: 63.0}", "require: {}", "say equals, one_of, at_least or at_most"),
        ("functions: [3, 6, 16]", "functions: [3, 5]", "functions"),
        ("    documented_s: 0.0\n", "", "give this or documented_s"),
        ("- name: speed_source", "- name: torque_source", "stands there twice"),
        ("register: {address: 113, ", "register: {address: 113, type: u16, ", "has no sign, and the setpoint"),
    ],
)
def test_wrong_profiles_are_reported_with_file_and_line(tmp_path: Path, old: str, new: str, words: str) -> None:
    text = text_of("siemens/g130-s120")
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DataFileError) as caught:
        load_modbus_profile(str(path))
    assert words in str(caught.value)
    assert all(problem.line and problem.file == str(path) for problem in caught.value.problems)
    assert all("\n" not in str(problem) for problem in caught.value.problems)


def test_a_fault_reaction_is_not_a_fault(tmp_path: Path) -> None:
    """The power stage is on in 000Fh (CiA 402-2). An older profile has fault for both states."""
    path = tmp_path / "mine.yaml"
    path.write_text(text_of("generic/modbus").replace("means: fault_reaction", "means: fault"), encoding="utf-8")
    with pytest.raises(DataFileError, match="000Fh is fault reaction active"):
        load_modbus_profile(str(path))


def test_an_echo_of_a_missing_setpoint(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text_of("delta/ms300").replace("- setpoint: speed", "- setpoint: torque"), encoding="utf-8")
    with pytest.raises(DataFileError, match="this profile has no torque setpoint"):
        load_modbus_profile(str(path))


def test_a_canopen_profile_is_not_accepted_as_a_modbus_profile() -> None:
    with pytest.raises(DataFileError, match="is a profile for canopen"):
        load_modbus_profile("generic/cia402")


def test_an_unknown_parameter_is_an_error() -> None:
    profile = load_modbus_profile("generic/modbus")
    assert all(profile.parameter(one.name) is one for one in profile.parameters)
    with pytest.raises(UsageError, match="generic/modbus: the profile has no parameter 'nothing'"):
        profile.parameter("nothing")
