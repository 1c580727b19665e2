"""All errors of a rig.yaml at once: contradictions between keys together with errors of other keys."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DataFileError
from tdhil.config.resolution import resolve
from tdhil.config.rig import load_rig
from tdhil.session.connection import connection_of
from tests.rigs import limits_text, loaded_rig


def rig_text(limits=(), **top):
    """Return a rig with one line per key, so that each error has its own line. None removes a key."""
    return "".join(f"{key}: {value}\n" for key, value in top.items()) + limits_text(**dict(limits))


def problems(path, text):
    path.write_text(text)
    with pytest.raises(DataFileError) as caught:
        load_rig(path)
    return [problem.message for problem in caught.value.problems]


CROSS = {
    "speed_min_rad_s: must be below": (("speed_min_rad_s", "12"),),
    "probe_torque_nm: must not be above": (("probe_torque_nm", "500"),),
    "needs allow_reverse: true": (("speed_min_rad_s", "-2"),),
    "must span at least 5 cycles": (("watchdog_s", "0.02"),),
    "string needs 'torque_ramp_nm_s'": (),
    "and real_time exclude each other": (),
    "needs speed_lag_s": (),
    "and host exclude each other": (),
}
OTHERS = {
    "a typing error elsewhere": {"nodee": "1"},
    "a wrong value elsewhere": {"node": "900"},
    "another wrong kind": {"gear": "{ratio: often}"},
    "a section that is none": {"expected": "7"},
}


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize("said", CROSS)
def test_a_contradiction_is_reported_beside_another_error(tmp_path, said, other):
    top = {
        "rate_hz": "100", "load": "string" if "string" in said else "none", "make_up_torque_nm": "29000",
        "run": "{real_time: true, stepped: true}" if "real_time" in said else "{seed: 1}",
        "drive_data": "{speed_lag_sd_s: 0.1}" if "lag" in said else "{torque_scale_rel_sd: 0.02}",
        "modbus": "{host: a, serial: b}" if "host" in said else "{port: 502}",
        **OTHERS[other],
    }
    found = problems(tmp_path / "rig.yaml", rig_text(CROSS[said], **top))
    assert sum(said in text for text in found) == 1, found
    assert len(found) == 2, found


def test_two_contradictions_and_an_error_in_the_same_section(tmp_path):
    limits = (("speed_min_rad_s", "-2"), ("probe_torque_nm", "500"), ("time_s", "soon"), ("speed_max_rad_s", "-3"))
    found = problems(tmp_path / "rig.yaml", rig_text(limits))
    for said in ("needs allow_reverse", "probe_torque_nm: must not be above", "time_s", "speed_max_rad_s: must be"):
        assert sum(said in text for text in found) == 1, found
    assert not any("must be below speed_max" in text for text in found)        # for an invalid highest speed


def test_no_contradiction_is_reported_for_a_wrong_value(tmp_path):
    found = problems(tmp_path / "rig.yaml", rig_text(
        (("speed_min_rad_s", "-2"), ("torque_nm", "much")), allow_reverse="perhaps", load="string",
        make_up_torque_nm="29000", torque_ramp_nm_s="slow", drive_data="{speed_lag_s: long, speed_lag_sd_s: 0.1}",
    ))
    assert len(found) == 4, found
    assert not any("needs" in text or "must not" in text for text in found)


def test_a_missing_key_suppresses_no_other_check(tmp_path):
    found = problems(tmp_path / "rig.yaml", rig_text((("time_s", None), ("probe_torque_nm", "500"))))
    assert any("'time_s' is missing" in text for text in found)
    assert any("probe_torque_nm: must not be above" in text for text in found)


@pytest.mark.heavy
@given(st.sets(st.sampled_from(["window", "probe", "reverse", "watchdog"])), st.booleans())
def test_a_report_does_not_depend_on_another_error(tmp_path_factory, wrong, beside):
    limits = {
        "window": ("speed_max_rad_s", "0.1"), "probe": ("probe_torque_nm", "500"), "reverse": ("speed_min_rad_s", "-2"),
        "watchdog": ("watchdog_s", "0.02"),
    }
    text = rig_text([limits[name] for name in sorted(wrong)], rate_hz="100", node="900" if beside else "1")
    path = tmp_path_factory.mktemp("rig") / "rig.yaml"
    expected = {"probe", "reverse", "watchdog"} & wrong | ({"window"} & wrong if "reverse" not in wrong else set())
    if not expected and not beside:
        path.write_text(text)
        load_rig(path)
        return
    assert len(problems(path, text)) == len(expected) + beside


OTHER_BUS = {
    "drive: canopen\nmodbus: {host: 192.0.2.10}\n": ("modbus", 2),
    "drive: canopen\nmodbus: {serial: /dev/ttyUSB0}\n": ("modbus", 2),
    "profile: maxon/epos4\nmodbus: {host: 192.0.2.10}\n": ("modbus", 2),
    "drive: modbus\nbus: {interface: socketcan, channel: can0}\n": ("bus", 2),
}


@pytest.mark.parametrize("text", OTHER_BUS)
def test_an_address_on_the_other_bus_does_not_select_the_simulator(tmp_path, no_bus_of_the_user, text):
    rig = loaded_rig(tmp_path, text)
    with pytest.raises(DataFileError) as caught:
        connection_of({}, rig, resolve({}, rig))
    (problem,) = caught.value.problems
    section, line = OTHER_BUS[text]
    assert problem.line == line
    assert problem.message.startswith(f"{section}: gives a drive's address")
    assert "--simulate" in problem.message


def test_it_is_accepted_with_an_explicit_choice(tmp_path, no_bus_of_the_user):
    rig = loaded_rig(tmp_path, "drive: canopen\nmodbus: {host: 192.0.2.10}\n")
    for cli in ({"simulate": True}, {"drive": "modbus"}, {"interface": "virtual", "channel": "a"}):
        connection_of(cli, rig, resolve(cli, rig))
