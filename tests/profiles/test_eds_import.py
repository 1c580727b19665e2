"""Profile from an EDS or DCF: content of the file, missing information, and wrong or hostile files.

The files are written here, in the form of CiA 306. The repository contains no file of a manufacturer.
"""

import math
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from profiles.canopen import CanopenProfile
from profiles.eds_import import begin_profile
from profiles.eds_reader import read_eds
from profiles.errors import DataFileError
from profiles.library import profile_path
from profiles.yaml_loader import load_model

OURS = profile_path("generic/cia402").parent / "cia402.eds"
U8, I8, U16, I16, U32, I32, F32, TEXT = 5, 2, 6, 3, 7, 4, 8, 9

DRIVE = {
    (0x1000, 0): (U32, "ro", 0, "0x00020192"), (0x1016, 1): (U32, "rw", 0, "0"), (0x1018, 1): (U32, "ro", 0, "0xAB"),
    (0x1018, 2): (U32, "ro", 0, "0x1234"), (0x1600, 1): (U32, "rw", 0, "0x60400010"),
    (0x1A00, 1): (U32, "rw", 0, "0x60410010"), (0x6007, 0): (I16, "rw", 0, "1"), (0x6040, 0): (U16, "rw", 1, "0"),
    (0x6041, 0): (U16, "ro", 1, ""), (0x605A, 0): (I16, "rw", 0, "2"), (0x6060, 0): (I8, "rw", 1, "0"),
    (0x6061, 0): (I8, "ro", 1, ""), (0x606C, 0): (I32, "ro", 1, ""), (0x6071, 0): (I16, "rw", 1, "0"),
    (0x6072, 0): (U16, "rw", 0, "1000"), (0x6076, 0): (U32, "rw", 0, "480000"), (0x6077, 0): (I16, "ro", 1, ""),
    (0x6080, 0): (U32, "rw", 0, "3000"), (0x6083, 0): (U32, "rw", 0, "100"), (0x6084, 0): (U32, "rw", 0, "100"),
    (0x6085, 0): (U32, "rw", 0, "100"), (0x60A9, 0): (U32, "rw", 0, "0xFDB44700"), (0x60FF, 0): (I32, "rw", 1, "0"),
    (0x6502, 0): (U32, "ro", 0, "0x0000030C"),
}
INFO = {"VendorName": "Acme Drives", "VendorNumber": "0xAB", "ProductName": "Mover 9", "ProductNumber": "0x1234"}


def eds(change=None, *, info=None, drop=(), extra="", values=None):
    """Return the text of an EDS; ``values`` makes it a DCF."""
    objects = {key: value for key, value in (DRIVE | (change or {})).items() if key not in drop and key[0] not in drop}
    lines = ["[DeviceInfo]", *(f"{key}={value}" for key, value in (INFO | (info or {})).items())]
    for index in sorted({index for index, _ in objects}):
        subs = [sub for at, sub in objects if at == index]
        if subs != [0]:
            lines += [f"[{index:04X}]", f"ParameterName=Object {index:04X}", "ObjectType=0x9"]
        for sub in subs:
            kind, access, mapped, default = objects[index, sub]
            lines += [f"[{index:04X}{f'sub{sub:X}' if subs != [0] else ''}]", f"ParameterName=Thing {sub}",
                      "ObjectType=0x7", f"DataType=0x{kind:04X}", f"AccessType={access}", f"PDOMapping={mapped}",
                      f"DefaultValue={default}"]
            if values and (index, sub) in values:
                lines.append(f"ParameterValue={values[index, sub]}")
    return "\n".join(lines) + "\n" + extra


@pytest.fixture
def begin(tmp_path):
    def begin(text, name="drive.eds"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return begin_profile(read_eds(path), str(path))

    return begin


def refused(begin, text, name="drive.eds"):
    with pytest.raises(DataFileError) as caught:
        begin(text, name)
    for problem in caught.value.problems:
        assert str(problem).isprintable()
        assert len(str(problem)) < 500
    return caught.value.problems


# -- content of the file ---------------------------------------------------------------------------------------------


def test_our_own_eds_gives_the_numbers_of_the_generic_profile(begin):
    """The result equals cia402.yaml for the same drive, except for entries that no EDS contains."""
    ours = load_model(profile_path("generic/cia402"), CanopenProfile)
    begun = begin(OURS.read_text(encoding="utf-8")).profile
    for section, keys in (
        ("modes", ("speed", "torque", "mapped")), ("speed", ("rpm_per_lsb", "max_motor_speed_rpm_per_lsb")),
        ("speed", ("acceleration_rpm_s_per_lsb", "deceleration_rpm_s_per_lsb")),
        ("torque", ("rated_torque_nm_per_lsb", "rated_per_lsb", "max_torque_rated_per_lsb", "has_demand")),
        ("torque", ("slope_rated_s_per_lsb",)), ("quick_stop", ("option_code", "deceleration_rpm_s_per_lsb", "ends")),
        ("watchdog", ("kind", "consumer_index", "reaction_index", "reaction_value", "reaction")),
        ("cyclic", ("has_period",)),
    ):
        for key in keys:
            assert getattr(getattr(begun, section), key) == getattr(getattr(ours, section), key), (section, key)
    assert begun.speed.si_unit == 0xFFB44700
    assert {"modes", "quick_stop", "torque", "watchdog"} <= set(begun.below("unverified"))


def test_every_open_entry_is_unverified_and_names_where_to_look(begin):
    begun = begin(eds())
    assert begun.profile.name == "acme-drives/mover-9"
    assert begun.profile.title == "Acme Drives Mover 9 (CANopen), from its EDS"
    assert begun.profile.below("unverified") == ("modes", "quick_stop", "torque", "watchdog")
    assert begun.profile.below("likely") == ("speed",)
    for section in ("modes", "quick_stop", "torque", "watchdog"):
        comment = begun.text.split(f"\n{section}:")[0].rpartition("\n\n")[2]
        assert "Look for: " in comment, section
    assert begun.profile.modes.switch_while_enabled is False
    assert begun.profile.quick_stop.decelerates_in_torque_mode is False
    assert (begun.profile.identity.vendor, begun.profile.identity.product) == (0xAB, 0x1234)
    assert begun.profile.hints == ()


@pytest.mark.parametrize(("unit", "rpm"), [
    ("0x00B44700", 1.0), ("0xFDB44700", 0.001), ("0x00B40300", 60.0), ("0xFEB40300", 0.6),
    ("0x00100300", 60.0 / (2.0 * math.pi)), ("0x00410300", 1.0 / 6.0), ("0xFF414700", 0.1 / 360.0),
])
def test_the_unit_of_speed_by_60a9h(begin, unit, rpm):
    """CiA 303-2: 47h is a minute, 03h a second, 10h a radian, 41h a degree, B4h a revolution; the prefix is above."""
    profile = begin(eds({(0x60A9, 0): (U32, "rw", 0, unit)})).profile
    assert profile.speed.rpm_per_lsb == pytest.approx(rpm, rel=1e-10)
    assert profile.speed.si_unit == int(unit, 16)
    assert profile.quick_stop.deceleration_rpm_s_per_lsb == pytest.approx(rpm, rel=1e-10)
    assert profile.speed.confidence == "likely"


@pytest.mark.parametrize("unit", ["0x00B54700", "0x00B44701", "0x00010300", "0x00000000", "0x7FB44700", ""])
def test_a_unit_that_is_no_speed_of_a_shaft_is_left_open_and_no_ramp_written(begin, unit):
    """A ramp in a wrong unit could make a stop last for minutes, so 6085h keeps the drive's value."""
    profile = begin(eds({(0x60A9, 0): (U32, "rw", 0, unit)})).profile
    assert profile.speed.confidence == "unverified"
    assert profile.speed.si_unit is None
    assert profile.quick_stop.deceleration_rpm_s_per_lsb is None
    assert profile.speed.acceleration_rpm_s_per_lsb is None
    assert profile.speed.deceleration_rpm_s_per_lsb is None


def test_encoder_counts_are_scaled_by_the_drives_own_objects(begin):
    """Counts per second with 608Fh and 6094h are calculated as in siemens/s120-canopen."""
    factors = {(0x608F, 1): (U32, "rw", 0, "8192"), (0x608F, 2): (U32, "rw", 0, "1"),
               (0x6094, 1): (U32, "rw", 0, "1"), (0x6094, 2): (U32, "rw", 0, "4")}
    begun = begin(eds(factors, drop=(0x60A9,)))
    speed = begun.profile.speed
    assert (speed.rpm_per_lsb, speed.confidence) == (60.0, "unverified")
    assert speed.times == ("encoder_revolutions", "velocity_numerator")
    assert speed.over == ("encoder_increments", "velocity_divisor")
    assert begun.profile.parameter("encoder_increments").default == 8192
    assert "6094h, velocity encoder factor: 1, 4." in begun.text
    assert begun.profile.quick_stop.deceleration_rpm_s_per_lsb is None


@pytest.mark.parametrize(("drop", "section", "key", "value", "words"), [
    ((0x6072,), "torque", "max_torque_rated_per_lsb", None, "set_to: torque_limit"),
    ((0x6076,), "torque", "rated_torque_nm_per_lsb", None, "drive_data.rated_torque_nm"),
    ((0x605A,), "quick_stop", "ends", "off", "releases the shaft"),
    ((0x6007,), "watchdog", "reaction", "coast", "the worst is written here"),
    ((0x1016,), "watchdog", "kind", "none", "refused but by name"),
    ((0x6071,), "modes", "torque", (), "No torque mode: 6071h"),
    ((0x6080,), "speed", "max_motor_speed_rpm_per_lsb", None, "Look for: velocity unit"),
    ((0x6085,), "quick_stop", "deceleration_rpm_s_per_lsb", None, "by hand"),
    ((0x6502,), "modes", "torque", (10, 4), "no value of 6502h"),
])
def test_a_missing_object_is_reported_in_words(begin, drop, section, key, value, words):
    begun = begin(eds(drop=drop))
    assert getattr(getattr(begun.profile, section), key) == value
    assert words in " ".join(begun.text.replace("\n#", "").split())


@pytest.mark.parametrize(("change", "section", "key", "value"), [
    ({(0x6072, 0): (F32, "rw", 1, "400.0")}, "torque", "max_torque_rated_per_lsb", None),
    ({(0x6085, 0): (F32, "rw", 1, "1.0")}, "quick_stop", "deceleration_rpm_s_per_lsb", None),
    ({(0x6072, 0): (U16, "ro", 1, "400")}, "torque", "max_torque_rated_per_lsb", None),
    ({(0x6060, 0): (I8, "rw", 0, "3")}, "modes", "torque", ()),
    ({(0x6071, 0): (I16, "rw", 0, "3")}, "modes", "torque", ()),
    ({(0x6502, 0): (U32, "ro", 0, "0x04")}, "modes", "torque", ()),
    ({(0x6502, 0): (U32, "ro", 0, "0x0104")}, "modes", "speed", (9, 3)),
    ({(0x6502, 0): (U32, "ro", 0, "0x0A")}, "modes", "speed", (3,)),
])
def test_another_type_or_no_access_counts_as_missing(begin, change, section, key, value):
    assert getattr(getattr(begin(eds(change)).profile, section), key) == value


def test_limits_of_the_file_are_used(begin):
    """With 605Ah up to 2 and 6007h up to 1, neither 6 nor 3 is written to such a drive."""
    text = eds().replace("[605A]\n", "[605A]\nHighLimit=2\n").replace("[6007]\n", "[6007]\nHighLimit=1\n")
    profile = begin(text).profile
    assert (profile.quick_stop.option_code, profile.quick_stop.ends) == (None, "off")
    assert (profile.watchdog.reaction_index, profile.watchdog.reaction) == (None, "coast")


@pytest.mark.parametrize(("drop", "modes"), [((0x60FF, 0x606C), "0x02"), ((), "0x22"), ((), "0x02"), ((0x60FF,), "")])
def test_a_drive_with_velocity_mode_alone(begin, drop, modes):
    """Velocity mode is usual for adapters of inverters. 6502h shows it, or a missing 60FFh."""
    change = {(0x6042, 0): (I16, "rw", 1, "0"), (0x6044, 0): (I16, "ro", 1, ""), (0x6502, 0): (U32, "ro", 0, modes),
              (0x604C, 1): (I32, "rw", 0, "1"), (0x604C, 2): (I32, "rw", 0, "10")}
    begun = begin(eds(change, drop=drop))
    assert begun.profile.speed.vl
    assert (begun.profile.modes.speed, begun.profile.modes.torque) == ((2,), ())
    assert (begun.profile.speed.rpm_per_lsb, begun.profile.speed.confidence) == (1.0, "unverified")
    assert begun.profile.quick_stop.deceleration_rpm_s_per_lsb is None
    assert "604Ch, vl dimension factor: 1, 10." in begun.text


def test_node_guarding_where_there_is_no_heartbeat(begin):
    guarding = {(0x100C, 0): (U16, "rw", 0, "0"), (0x100D, 0): (U8, "rw", 0, "0")}
    watchdog = begin(eds(guarding, drop=(0x1016,))).profile.watchdog
    assert (watchdog.kind, watchdog.reaction) == ("node_guarding", "quick_stop")


def test_torque_that_cannot_be_mapped_and_a_fixed_mapping_are_hints(begin):
    profile = begin(eds({(0x6077, 0): (I16, "ro", 0, ""), (0x1600, 1): (U32, "const", 0, "0x60400010")})).profile
    assert any("6077h" in hint and "torque.actual" in hint for hint in profile.hints)
    assert any("1600h can't be written" in hint for hint in profile.hints)


def test_a_dcf_contains_the_settings_of_one_drive(begin):
    text = eds(values={(0x60A9, 0): "0xFFB44700", (0x6076, 0): "512871", (0x6502, 0): "0x204"},
               extra="[DeviceComissioning]\nNodeID=17\nBaudrate=500\n")
    begun = begin(text, "drive.dcf")
    assert begun.profile.node == 17
    assert begun.profile.speed.si_unit == 0xFFB44700
    assert begun.profile.modes.speed == (3,)
    assert begun.profile.modes.torque == (10,)
    assert "6076h is 512871: 512.871 N·m if that is mN·m" in begun.text
    assert begun.profile.title.endswith("from its DCF")


def test_an_unnamed_manufacturer(begin):
    profile = begin(eds(info={"VendorNumber": "0", "VendorName": "", "ProductName": ""}, drop=(0x1018,))).profile
    assert profile.identity.vendor is None
    assert profile.identity.confidence == "unverified"
    assert profile.name == "vendor/drive"


def test_habits_of_real_files(begin):
    """The file has Latin-1, carriage returns, a byte-order mark, inline comments, and keywords in other capitals.

    It also has SUB for sub, indented lines, a compact array, vendor types, a $NODEID and unused sections.
"""
    text = eds(extra="[2000]\nParameterName=X\nDataType=0x0047\nAccessType=rw\n[40]\nParameterName=t\nObjectType=5\n"
                     "[1400]\nParameterName=r\nObjectType=9\n[1400sub1]\nParameterName=c\nDataType=7\nAccessType=rw\n"
                     "DefaultValue=$NODEID+0x200\n[1010]\nParameterName=s\nObjectType=8\nDataType=7\nAccessType=rw\n"
                     "CompactSubObj=4\n[Comments]\nLines=x\n[DummyUsage]\nDummy0001=\n[Tool]\nwhat ever=1\n")
    text = text.replace("AccessType=rw", "accesstype=RW ; as it is").replace("1016sub1", "1016SUB01")
    text = text.replace("DataType", "   DATATYPE").replace("\n", "\r\n").replace("Acme", "Ácmé")
    plain = begin(eds()).profile
    for raw in (text.encode("latin-1"), b"\xef\xbb\xbf" + text.encode()):
        profile = begin(raw).profile
        assert profile.model_dump(exclude={"name", "title"}) == plain.model_dump(exclude={"name", "title"})
        assert profile.title == "Ácmé Drives Mover 9 (CANopen), from its EDS"


# -- files that are wrong ----------------------------------------------------------------------------------------------


def line_of(text, start):
    return next(number for number, line in enumerate(text.splitlines(), start=1) if line.startswith(start))


@pytest.mark.parametrize(("old", "new", "at", "words"), [
    ("VendorNumber=0xAB", "VendorNumber=", "VendorNumber", "VendorNumber is empty: must be a number"),
    ("VendorNumber=0xAB", "VendorNumber=none", "VendorNumber", "'none': must be a number"),
    ("VendorNumber=0xAB", "VendorNumber=-1", "VendorNumber", "from 0 to"),
    ("ProductNumber=0x1234", "ProductNumber=0x123456789", "ProductNumber", "from 0 to"),
    ("[606C]", "[606C", "[606C", "between [ and ]"),
    ("[606C]", "what is this\n[606C]", "what", "neither [section], key=value nor a comment"),
    ("[606C]\nParameterName=Thing 0", "[606C]\nParameterNme=x", "[606C]", "606C has no ParameterName"),
    ("[606C]\n", "[606C]\nParameterName=twice\n", "ParameterName=Thing 0", "stands twice"),
    ("[1016sub1]", "[1F16sub1]", "[1F16sub1]", "no section [1F16]"),
    ("DefaultValue=0xFDB44700", "DefaultValue=fast", "DefaultValue=fast", "DefaultValue of 60A9 is 'fast'"),
    ("DefaultValue=0x0000030C", "DefaultValue=0x30C0000000000000000000", "DefaultValue=0x30C0", "of 6502 is"),
    ("DefaultValue=480000", "DefaultValue=480000\nHighLimit=lots", "HighLimit", "HighLimit of 6076 is 'lots'"),
])
def test_an_error_is_reported_with_its_line(begin, old, new, at, words):
    assert old in eds()
    text = eds().replace(old, new, 1)
    problems = refused(begin, text)
    assert any(words in str(problem) for problem in problems), [str(problem) for problem in problems]
    if "stands twice" not in words:
        assert problems[0].line == line_of(text, at)


@pytest.mark.parametrize(("text", "words"), [
    ("", "no section [DeviceInfo]"), ("VendorName=x\n", "before the first [section]"),
    (b"[DeviceInfo]\nVendorName=a\0b\n", "zero bytes"), ("[DeviceInfo]\n", "no CiA 402 drive"),
    (eds(drop=(0x60FF,)), "60FFh (target velocity)"),
    (eds({(0x6042, 0): (I16, "rw", 1, "0")}, drop=(0x60FF,)), "6044h (vl velocity actual)"),
    (eds({(0x6042, 0): (I32, "rw", 1, "0"), (0x6044, 0): (I16, "ro", 1, "")}, drop=(0x60FF,)), "is i32: must be i16"),
    (eds({(0x1000, 0): (U32, "ro", 0, "0x00030191")}), "device profile 401"),
    (eds({(0x60FF, 0): (I16, "rw", 1, "0")}), "is i16: must be i32"),
    (eds(extra="[606C]\nParameterName=again\nDataType=7\nAccessType=ro\n"), "a second time; first in line"),
    (eds(extra="[OptionalObjects]\nSupportedObjects=1\n1=0x6099\n"), "lists 0x6099, which no section [6099] describes"),
    (eds(extra="[2001]\nParameterName=x\nObjectType=77\n"), "ObjectType is 77"),
    (eds(extra="[2001]\nParameterName=x\nDataType=7\nAccessType=maybe\n"), "AccessType is 'maybe'"),
    (eds(extra="[2001]\nParameterName=x\n"), "has no DataType"),
    (eds(extra="[DeviceComissioning]\nNodeID=200\n"), "from 1 to 127"),
    ("x" * (8 * 1024 * 1024 + 1), "larger than"),
])
def test_files_that_are_no_eds_of_a_drive(begin, text, words):
    assert any(words in str(problem) for problem in refused(begin, text))


def test_every_problem_at_once_and_not_too_many(begin):
    text = eds().replace("AccessType=rw", "AccessType=often").replace("VendorNumber=0xAB", "VendorNumber=")
    problems = refused(begin, text)
    assert len(problems) > 10
    assert [problem.line for problem in problems] == sorted(problem.line for problem in problems)
    problems = refused(begin, "[DeviceInfo]\n" + "rubbish\n" * 500)
    assert len(problems) == 21
    assert "480 more problems" in str(problems[-1])


@pytest.mark.parametrize("name", ["drive.xdd", "drive.epf", "drive"])
def test_other_formats_are_refused_by_name(begin, name):
    assert "neither .eds nor .dcf" in str(refused(begin, eds(), name)[0])


def test_no_such_file_and_a_folder(tmp_path):
    for path in (tmp_path / "none.eds", tmp_path):
        with pytest.raises(DataFileError):
            read_eds(path)


# -- hostile or damaged files --------------------------------------------------------------------------

NASTY = st.text(
    alphabet=st.one_of(st.sampled_from("\"'\\:#{}[]&*!|>%@`,-?\t\x1b\u202e\u2028\ufeff=;"), st.characters()),
    max_size=90,
)


@pytest.mark.heavy
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(vendor=NASTY, product=NASTY, thing=NASTY)
def test_no_name_breaks_out_of_the_profile(begin, vendor, product, thing):
    """With any names, the profile differs only in name and title, on printable lines."""
    def name(text):
        return " ".join(re.split(r"[\r\n\0]", text.encode("utf-8", "replace").decode()))

    text = eds(info={"VendorName": name(vendor), "ProductName": name(product)}).replace("Thing 0", f"Zqx {name(thing)}")
    plain, begun = begin(eds()), begin(text)
    assert begun.profile.model_dump(exclude={"name", "title"}) == plain.profile.model_dump(exclude={"name", "title"})
    assert all(line.isprintable() for line in begun.text.splitlines())
    assert max(map(len, begun.text.splitlines())) < 250
    assert "Zqx" not in begun.text                              # only the two names are text of the manufacturer


@pytest.mark.heavy
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_mutilated_file_is_refused_in_lines_or_gives_a_profile_that_loads(begin, tmp_path, data):
    """Lines are lost, duplicated, truncated, swapped or changed. The only exception is DataFileError."""
    lines = eds().splitlines()
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(lines) - 1))
        match data.draw(st.sampled_from(["lose", "double", "cut", "swap", "sign"])):
            case "lose":
                del lines[at]
            case "double":
                lines.insert(at, lines[at])
            case "cut":
                lines[at] = lines[at][: data.draw(st.integers(0, len(lines[at])))]
            case "swap":
                lines[at], lines[0] = lines[0], lines[at]
            case "sign":
                place = data.draw(st.integers(0, len(lines[at])))
                lines[at] = lines[at][:place] + data.draw(st.characters(exclude_categories=["Cs"])) + lines[at][place:]
    try:
        begun = begin("\n".join(lines))
    except DataFileError as error:
        assert error.problems
        assert all(str(problem).isprintable() for problem in error.problems)
        return
    path = Path(tmp_path / "begun.yaml")
    path.write_text(begun.text, encoding="utf-8")
    assert load_model(path, CanopenProfile) == begun.profile
