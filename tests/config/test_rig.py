"""rig.yaml: accepted entries, refusals with their line, and precedence of sources."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers.errors import DataFileError, PreflightRefused
from tdhil.config.options import OPTIONS
from tdhil.config.resolution import resolve
from tdhil.config.rig import Limits, require_limits, simulated_default_rig
from tdhil.errors import UsageError
from tdhil.session.task import pipe_of
from tests.rigs import loaded_rig

FULL = """\
drive: canopen
bus: {interface: socketcan, channel: can0, bitrate: 500000, options: {receive_own_messages: true}}
node: 5
profile: mine.yaml
rate_hz: 200
limits:
  speed_min_rad_s: 1
  speed_max_rad_s: 8.5
  torque_nm: 4e2
  time_s: 600
  quick_stop_rad_s2: 2
  watchdog_s: 0.25
  probe_torque_nm: 150
  probe_travel_rad: 2
gear: {ratio: 10.5}
load: string
make_up_torque_nm: 900
torque_ramp_nm_s: 50
allow_reverse: false
drive_data:
  rated_torque_nm: 1000
  torque_scale_rel_sd: 0.03
  speed_lag_s: 0.4
  speed_lag_sd_s: 0.02
accept_unverified: [watchdog, likely]
modbus: {host: 192.0.2.10, port: 5020, unit: 7}
letterhead: letterhead.yaml
reference_inertia_kg_m2: 104
run:
  highest_speed_rad_s: 9
  excitation: sine
  mode: speed
  frequency_hz: 0.3
  amplitude_rad_s: 1
  offset_rad_s: 4
  periods: 12
  tolerance: 0.03
  confidence: 0.99
  seed: 7
  simulate: false
  real_time: true
  stepped: false
  json: true
  log: here.mcap
  plant: plant.yaml
  trace: shaft.csv
  max_time_s: 300
  model: two-mass
  impedance: offset
  string_impedance_nm_s_rad: 296.5
  simulated_torque_scale: 1.05
  simulated_speed_scale: 0.99
  simulated_added_inertia_kg_m2: 55
  realisations: 2
"""


def problems(tmp_path: Path, text: str) -> list[tuple[int, str]]:
    with pytest.raises(DataFileError) as caught:
        loaded_rig(tmp_path, text)
    return [(problem.line, problem.message) for problem in caught.value.problems]


def test_everything_has_its_place(tmp_path: Path) -> None:
    rig = loaded_rig(tmp_path, FULL)
    assert rig.limits is not None
    assert rig.limits.torque_nm == 400
    assert rig.run.json_ is True
    assert (rig.line("limits.torque_nm"), rig.source("run.seed")) == (9, "rig.yaml:39")
    assert require_limits(rig) is rig.limits
    for option in OPTIONS:
        assert not option.at or rig.get(option.at) is not None, f"{option.at} is missing in FULL"


def test_an_almost_empty_rig_is_sufficient(tmp_path: Path) -> None:
    rig = loaded_rig(tmp_path, "node: 3\n")
    assert rig.limits is None
    assert (rig.gear.ratio, rig.load.kind, rig.allow_reverse) == (1.0, "none", False)
    with pytest.raises(ValidationError):
        rig.node = 4


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("speed_min_rad_s: 1", "speed_min_rad_s: 9", 7, "must be below speed_max_rad_s, which is 8.5"),
        ("speed_min_rad_s: 1", "speed_min_rad_s: -1", 7, "allow_reverse"),
        ("probe_torque_nm: 150", "probe_torque_nm: 500", 13, "must not be above torque_nm"),
        ("quick_stop_rad_s2: 2", "quick_stop_rad_s2: 0.05", 11, "in 170 s, more than the limit of 90 s: give 0.094"),
        ("make_up_torque_nm: 900", "make_up_torque_nm: 400", 9, "must be below make_up_torque_nm, which is 400"),
        ("torque_ramp_nm_s: 50\n", "", 16, "string needs 'torque_ramp_nm_s'"),
        ("watchdog_s: 0.25", "watchdog_s: 0.02", 12, "at least 5 cycles (0.025 s"),
        ("  speed_lag_s: 0.4\n", "", 23, "needs speed_lag_s"),
        ("stepped: false", "stepped: true", 42, "exclude each other"),
        ("torque_nm: 4e2", "torque_nm: '4e2'", 9, "write 4e2 without quotes"),
        ("  time_s: 600\n", "", 6, "'time_s' is missing"),
        ("node: 5", "node: 128", 3, "at most 127"),
        ("json: true", "jsn: true", 43, "did you mean 'json'?"),
        ("allow_reverse: false", "allow_reverse: off", 19, "write false"),
        ("quick_stop_rad_s2: 2", "quick_stop_rad_s2: 0.005", 11, "in 1700 s, more than the limit of 90 s"),
        ("ratio: 10.5", "ratio: 0", 15, "must be greater than 0, not 0"),
        ("ratio: 10.5", "ratio: 1e-7", 15, "must be at least 1e-06, not 1e-07"),
        ("torque_nm: 4e2", "torque_nm: -5.0", 9, "must be greater than 0, not -5"),
        ("confidence: 0.99", "confidence: 95", 38,
         "must be less than 1, not 95; 95 means 9500 %. For 95 % write 95% or 0.95"),
        ("accept_unverified: [watchdog, likely]", "accept_unverified: likely", 25, "a list"),
        ("unit: 7}", "unit: 256}", 26, "at most 255"),
        ("unit: 7}", "serial: /dev/ttyUSB0}", 26, "exclude each other"),
        ("host: 192.0.2.10, port: 5020, unit: 7", "serial: /dev/ttyUSB0, unit: 250", 26, "1 to 247 on a serial line"),
        ("host: 192.0.2.10, port: 5020", "serial: /dev/ttyUSB0, parity: none", 26, "'N', 'E' or 'O'"),
        ("  speed_lag_s: 0.4\n", "  speed_lag_s: 0.4\n  parameters: {speed_scaling: fast}\n", 24, "a number"),
    ],
)
def test_what_is_refused(tmp_path: Path, old: str, new: str, line: int, words: str) -> None:
    assert old in FULL
    found = problems(tmp_path, FULL.replace(old, new))
    assert any(at == line and words in message for at, message in found), found


def test_problems_across_keys_are_reported_together(tmp_path: Path) -> None:
    text = FULL.replace("torque_ramp_nm_s: 50\n", "").replace("make_up_torque_nm: 900", "make_up_torque_nm: 300")
    assert [line for line, _ in problems(tmp_path, text)] == [9, 16]


def test_a_real_drive_needs_limits(tmp_path: Path) -> None:
    for rig in (None, loaded_rig(tmp_path, "node: 3\n")):
        with pytest.raises(PreflightRefused) as caught:
            require_limits(rig)
        assert "speed_max_rad_s" in str(caught.value)
        assert "watchdog_s" not in str(caught.value)      # it has a default


def test_the_simulated_rig_needs_none(tmp_path: Path) -> None:
    limits = require_limits(simulated_default_rig())
    assert (limits.speed_min_rad_s, limits.speed_max_rad_s, limits.torque_nm) == (0.5, 10.0, 400.0)
    assert simulated_default_rig().drive_data.torque_scale_rel_sd == 0.02
    mine = simulated_default_rig(loaded_rig(tmp_path, FULL))
    assert mine == loaded_rig(tmp_path, FULL)
    assert mine.source("node") == "rig.yaml:3"
    some = simulated_default_rig(loaded_rig(tmp_path, "node: 3\ndrive_data: {speed_lag_s: 0.1}\n"))
    assert (some.node, some.drive_data.speed_lag_s, require_limits(some)) == (3, 0.1, limits)


def test_a_rig_that_the_simulated_limits_do_not_fit(tmp_path: Path) -> None:
    rig = loaded_rig(tmp_path, "load: string\nmake_up_torque_nm: 300\ntorque_ramp_nm_s: 5\n")
    with pytest.raises(DataFileError, match="must be below make_up_torque_nm"):
        simulated_default_rig(rig)


def test_command_line_before_rig_before_default(tmp_path: Path) -> None:
    found = resolve({"node": 9, "seed": None}, loaded_rig(tmp_path, "node: 3\nrun:\n  seed: 7\n"))
    assert (found.node, found.source("node")) == (9, "--node")
    assert (found.seed, found.source("seed")) == (7, "rig.yaml:3")
    assert (found.excitation, found.source("excitation")) == ("multisine", "default")
    assert ("node", "9", "--node") in list(found.rows())
    assert ("mode", "-", "default") in list(found.rows())
    assert ("yes", "false", "default") in list(found.rows())


def test_every_option_can_stand_in_the_rig(tmp_path: Path) -> None:
    found = resolve({}, loaded_rig(tmp_path, FULL))
    assert all(found.source(option.name).startswith("rig.yaml:") for option in OPTIONS if option.at)


def test_an_override_in_both_places_counts_once(tmp_path: Path) -> None:
    rig = loaded_rig(tmp_path, "accept_unverified: [watchdog, likely]\n")
    found = resolve({"accept_unverified": ["speed", "watchdog"]}, rig)
    assert found.accept_unverified == ("speed", "watchdog", "likely")
    assert found.source("accept_unverified") == "--accept-unverified and rig.yaml:1"
    assert ("accept_unverified", "speed, watchdog, likely", "--accept-unverified and rig.yaml:1") in list(found.rows())
    assert resolve({}, None).accept_unverified == ()


def test_files_named_in_the_rig_are_relative_to_it(tmp_path: Path) -> None:
    found = resolve({}, loaded_rig(tmp_path, FULL))
    assert found.plant == str(tmp_path / "plant.yaml")
    assert found.profile == str(tmp_path / "mine.yaml")
    assert found.log == "here.mcap"
    found = resolve({"plant": "p.yaml"}, loaded_rig(tmp_path, "profile: generic/cia402"))
    assert (found.plant, found.profile) == ("p.yaml", "generic/cia402")


def test_the_clock_of_the_command_line_replaces_the_rigs(tmp_path: Path) -> None:
    found = resolve({"stepped": True}, loaded_rig(tmp_path, FULL))
    assert (found.stepped, found.real_time, found.source("real_time")) == (True, False, "--stepped")


def test_wrong_values_on_the_command_line_are_named_all() -> None:
    with pytest.raises(UsageError) as caught:
        resolve({"node": 300, "periods": 0, "real_time": True, "stepped": True}, None)
    text = str(caught.value)
    assert "--node: must be at most 127, not 300" in text
    assert "--periods" in text


def test_real_time_and_stepped_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="--stepped: and real_time exclude each other"):
        resolve({"real_time": True, "stepped": True}, None)


def test_limits_in_python_are_checked_too() -> None:
    with pytest.raises(ValidationError, match="must be below speed_max_rad_s"):
        Limits(
            speed_min_rad_s=3, speed_max_rad_s=2, torque_nm=1, time_s=1, quick_stop_rad_s2=1,
            probe_torque_nm=1, probe_travel_rad=1,
        )


STRING_KEYS = "make_up_torque_nm: 300\ntorque_ramp_nm_s: 5\n"


def test_a_string_may_be_a_word_or_a_pipe_with_its_sizes(tmp_path):
    assert loaded_rig(tmp_path, "load: string\n" + STRING_KEYS).load.kind == "string"
    pipe = "load: {kind: string, length_m: 2300, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}\n"
    load = loaded_rig(tmp_path, pipe + STRING_KEYS).load
    assert (load.kind, load.length_m, load.outer_diameter_m, load.inner_diameter_m) == ("string", 2300.0, 0.127, 0.1086)
    assert load.tolerance == 0.03


@pytest.mark.parametrize(("load", "said"), [
    ("chain", "load"),
    ("{kind: string, length_m: 2300}", "needs 'outer_diameter_m' beside it"),
    ("{kind: string, length_m: 2300, outer_diameter_m: 0.1, inner_diameter_m: 0.1}", "less than outer_diameter_m"),
    ("{kind: none, length_m: 2300}", "belongs to kind: string"),
    ("{kind: string, lenght_m: 2300}", "lenght_m"),
])
def test_an_invalid_load_is_refused_with_its_line(load, said, tmp_path):
    with pytest.raises(DataFileError, match=said) as refused:
        loaded_rig(tmp_path, f"node: 5\nload: {load}\n" + STRING_KEYS)
    assert "rig.yaml:2" in str(refused.value)


def test_the_pipe_follows_from_its_dimensions_at_the_motor(tmp_path):
    pipe = "load: {kind: string, length_m: 3000, outer_diameter_m: 0.127, inner_diameter_m: 0.1086}\n"
    found = pipe_of(loaded_rig(tmp_path, "gear: {ratio: 2}\n" + pipe + STRING_KEYS))
    assert 4.0 * found.impedance_nm_s_rad == pytest.approx(296.5, rel=1e-3)
    assert 2.0 * found.delay_s == pytest.approx(1.888, rel=1e-3)
    assert pipe_of(loaded_rig(tmp_path, "load: string\n" + STRING_KEYS)) is None
