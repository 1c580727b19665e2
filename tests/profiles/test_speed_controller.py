"""Speed controller in a profile: values read from the drive, and the parameters of its notch."""

from pathlib import Path

import pytest

from profiles.errors import DataFileError
from profiles.library import load_canopen_profile, load_modbus_profile, load_profile, profile_path

NOTCH = "  notch:\n    - {title: p2301, quantity: width_hz, source: the manual, confidence: likely}\n"
FREQUENCY = "    - {title: p2302, quantity: frequency_hz, source: the manual, confidence: likely}\n"


@pytest.mark.parametrize(("name", "units"), [
    ("generic/cia402", ("nm_s_rad", "nm_rad", "s")), ("generic/cia402-ethercat", ("nm_s_rad", "nm_rad", "s")),
    ("generic/modbus", ("nm_s_rad", "ms", "ms")),
])
def test_the_generic_profiles_read_gain_integral_and_filter(name: str, units: tuple[str, ...]) -> None:
    profile = load_profile(name)
    controller = profile.speed_controller
    assert controller is not None and controller.filter is not None
    assert (controller.gain.unit, controller.integral.unit, controller.filter.unit) == units
    assert list(controller.read_from()) == ["gain", "integral", "filter"]
    assert {f"parameters.{one}" for one in controller.read_from().values()} <= {one for one, _ in profile.entries()}


def test_the_standard_has_no_object_for_gains_so_they_are_those_of_the_simulated_drive_only() -> None:
    for name in ("generic/cia402", "generic/cia402-ethercat"):
        controller = load_profile(name).speed_controller
        assert controller is not None and controller.simulated_only


@pytest.mark.parametrize(("name", "load", "old", "new", "words"), [
    ("generic/cia402", load_canopen_profile, "parameter: speed_gain", "parameter: no_gain", "no parameter 'no_gain'"),
    ("generic/modbus", load_modbus_profile, "parameter: speed_gain", "parameter: no_gain", "no parameter 'no_gain'"),
    ("generic/cia402", load_canopen_profile, "  simulated_only: true\n", NOTCH, "a notch needs its frequency_hz"),
    ("generic/cia402", load_canopen_profile, "  simulated_only: true\n", NOTCH + FREQUENCY + FREQUENCY,
     "frequency_hz stands there twice"),
])
def test_wrong_entries_are_reported_with_their_line(tmp_path, name, load, old, new, words) -> None:
    text = Path(profile_path(name)).read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(old, new, 1).replace("eds: cia402.eds", "eds: null"), encoding="utf-8")
    with pytest.raises(DataFileError) as caught:
        load(str(path))
    assert words in str(caught.value)
    assert all(problem.line for problem in caught.value.problems)
