"""CANopen profiles: entries beyond the usual objects of CiA 402, and refusals with their line."""

from pathlib import Path

import pytest

from profiles.errors import DataFileError, UsageError
from profiles.library import load_canopen_profile, profile_path

S120 = profile_path("siemens/s120-canopen").read_text(encoding="utf-8")
EPOS4 = profile_path("maxon/epos4").read_text(encoding="utf-8")


@pytest.mark.parametrize(("text", "old", "new", "words"), [
    (S120, "mapped: false", "mapped: false\n  torque: [4]", "twice"),
    (S120, "  torque: []\n", "  torque: [4]\n", "6060h must be mappable"),
    (S120, "over: [velocity_divisor,", "over: [velocity_division,", "no parameter 'velocity_division'"),
    (S120, "times: [velocity_numerator]", "times: [nothing]", "no parameter 'nothing'"),
    (S120, "from_speed: speed_limit", "from_speed: speed", "no parameter 'speed'"),
    (S120, "    from_speed: speed_limit\n", "", "is needed there"),
    (S120, "name: velocity_divisor", "name: velocity_numerator", "stands there twice"),
    (S120, "life_time_factor: 4", "life_time_factor: 1", "2"),
    (S120, "kind: node_guarding", "kind: node_guard", "did you mean 'node_guarding'?"),
    (S120, "type: i16, per_lsb: 0.00006103515625, unit: rated", "type: u16, per_lsb: 0.1, unit: rated", "has a sign"),
    (S120, "require: {equals: 2}", "require: {}", "say equals"),
    (S120, "scale: power_of_two", "scale: power_of_two\n    per_lsb: 2.0", "power_of_two goes with neither"),
    (S120, "type: f32\n    unit: nm\n    set_to: torque_limit_reverse",
     "type: u16\n    unit: nm\n    set_to: torque_limit_reverse", "a reverse limit is negative"),
    (EPOS4, "require: {at_least: 1}", "require: {at_least: 1}\n    set_to: torque_limit", "leave 'require' out"),
    (EPOS4, "    default: 0\n", "    default: 0\n    times: output_current_limit\n", "by another one itself"),
    (EPOS4, "  option_code: 6", "  option_code: 0", "with 0 the shaft coasts"),
])
def test_wrong_profiles(tmp_path: Path, text: str, old: str, new: str, words: str) -> None:
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DataFileError) as caught:
        load_canopen_profile(str(path))
    assert words in str(caught.value)
    assert all(problem.line for problem in caught.value.problems)


def test_missing_entries_have_the_values_of_cia402() -> None:
    """Older profiles keep their meaning."""
    profile = load_canopen_profile("generic/cia402")
    assert (profile.torque.rated.index, profile.torque.rated.type, profile.torque.actual) == (0x6076, "u32", None)
    assert profile.modes.mapped and profile.cyclic.has_period
    assert profile.speed.times == profile.speed.over == ()
    assert [one.name for one in profile.parameters] == list(profile.speed_controller.read_from().values())
    assert profile.quick_stop.ends == "quick_stop"
    assert profile.speed.si_unit is None


def test_every_claim_has_its_source_and_its_confidence() -> None:
    for name in ("maxon/epos4", "siemens/s120-canopen"):
        profile = load_canopen_profile(name)
        entries = dict(profile.entries())
        assert {f"parameters.{one.name}" for one in profile.parameters} <= set(entries)
        assert all(len(entry.source) > 10 for entry in entries.values())
    assert load_canopen_profile("siemens/s120-canopen").below("unverified") == ("parameters.torque_source",)
    assert load_canopen_profile("maxon/epos4").below("unverified") == ()


def test_a_parameter_by_its_name() -> None:
    profile = load_canopen_profile("siemens/s120-canopen")
    assert profile.parameter("speed_limit").index == 0x243A
    with pytest.raises(UsageError, match="s120-canopen: the profile has no parameter 'nothing'"):
        profile.parameter("nothing")
