"""Survey of a trace with unknown columns: header, guess, and all errors of a choice at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdhil.errors import CsvMisnamed, CsvUnusable
from tdhil.recording import column_mistakes, parse_columns, survey_trace, units_of
from tdhil.session import read, write_as_log

USUAL = "time_s,speed_rad_s,torque_nm\n0,4,92\n0.01,4.1,93\n"
GERMAN = ("Gerät;Umrichter 7\nDatum;01.05.2024\n\nZeit;Solldrehzahl;Drehzahl;Drehmoment [kNm]\nms;U/min;U/min;\n"
          "0,0;38;38,3;0,0924\n10,0;38;38,4;0,0931\n")
AXIS = ("Axis 1: Speed setpoint [rpm],Axis 1: Actual speed [rpm],Axis 1: Actual torque [%],t [ms],state\n"
        "1,2,3,0,run\n1,2,3,1,run\n")


def survey(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "trace.csv"
    path.write_bytes(text.encode(encoding))
    return survey_trace(path)


@pytest.mark.parametrize(("text", "line", "guess"), [
    (USUAL, 1, [("time_s", "s"), ("speed_rad_s", "rad/s"), ("torque_nm", "N·m")]),
    (GERMAN, 4, [("Zeit", "ms"), ("Drehzahl", "rpm"), ("Drehmoment [kNm]", "kN·m")]),
    (AXIS, 1, [("t [ms]", "ms"), ("Axis 1: Actual speed [rpm]", "rpm"), ("Axis 1: Actual torque [%]", "%")]),
    ("timestamp,nAct,mAct\n2024-05-01T12:00:00.1,3,4\n2024-05-01T12:00:00.2,3,4\n", 1,
     [("timestamp", ""), ("nAct", ""), ("mAct", "")]),
    ("a,b\n1,2\n2,3\n", 1, [("", ""), ("", ""), ("", "")]),
])
def test_header_and_columns_are_found(tmp_path, text, line, guess):
    found = survey(tmp_path, text)
    assert found.line == line
    assert [(one.column, one.unit) for one in found.guess] == guess
    assert all(len(row) == len(found.names) == len(found.units) for row in found.rows)


def test_a_setpoint_is_not_used_as_the_reported_value(tmp_path):
    found = survey(tmp_path, "t_s,n_set_rpm,n_act_rpm,m_set_nm,m_act_nm\n0,1,2,3,4\n1,2,3,4,5\n")
    assert [one.column for one in found.guess] == ["t_s", "n_act_rpm", "m_act_nm"]


@pytest.mark.parametrize("name", ["Sollmoment [Nm]", "torque limit [Nm]", "target torque [Nm]", "m_soll_nm"])
def test_a_setpoint_alone_is_not_guessed(tmp_path, name):
    found = survey(tmp_path, f"t_s,n_act_rpm,{name}\n0,1,2\n1,2,3\n")
    assert [one.column for one in found.guess] == ["t_s", "n_act_rpm", ""]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_encodings_are_recognised(tmp_path, encoding):
    found = survey(tmp_path, GERMAN, encoding)
    assert (found.names[0], found.comma, found.units[2]) == ("Zeit", True, "U/min")


@pytest.mark.parametrize(("text", "kind", "said"), [
    ("x\n1\n2\n", CsvUnusable, "no table"), ("1,2,3\n1,2,3\n", CsvMisnamed, "no header"), ("", CsvUnusable, "empty"),
    ("time_s,speed_rad_s,torque_nm\n", CsvUnusable, "no row of numbers"), ("\0\1\2" * 99, CsvUnusable, "neither text"),
])
def test_a_file_without_a_table_is_reported(tmp_path, text, kind, said):
    with pytest.raises(kind, match=said):
        survey(tmp_path, text)


def test_every_error_in_a_choice_is_reported_at_its_quantity():
    found = list(column_mistakes(["speed=n:furlong", "torque=m:%", "time=q"], ["t", "n", "m"], rated=False))
    assert [quantity for quantity, _ in found] == ["speed", "rated", "time"]
    assert list(column_mistakes(["time=t", "speed=n:rpm", "torque=n:Nm"], ["t", "n"], rated=False)) == [
        ("torque", "This column is already that of speed")]
    assert [quantity for quantity, _ in column_mistakes(["time=t"], ["t"], rated=False)] == ["speed", "torque"]
    ((quantity, _),) = column_mistakes(["speed=a", "time=t", "torque=m"], ["t", "a", "A", "m"], rated=True)
    assert quantity == "speed"


NAMES = st.lists(st.text(st.characters(codec="utf-8", exclude_characters="\r\n"), max_size=12), max_size=6)


any_choice = given(names=NAMES, items=st.lists(st.text(max_size=20), max_size=5))


@pytest.mark.heavy
@settings(max_examples=10, deadline=None)
@any_choice
def test_no_choice_raises_and_a_right_one_has_no_error(names, items):
    choose(names, items)


@pytest.mark.heavy
@settings(max_examples=60, deadline=None)
@any_choice
def test_more_choices_raise_nothing(names, items):
    choose(names, items)


def choose(names, items):
    for quantity, text in column_mistakes(items, names, rated=False):
        assert quantity in ("time", "speed", "torque", "rated", "") and text
    right = ["time=t:ms", "speed=Drehzahl [U/min]:rpm", "torque=m:Nm"]
    assert list(column_mistakes(right, ["t", "Drehzahl [U/min]", "m"], rated=False)) == []
    assert [one.unit.symbol for one in parse_columns(right)] == ["ms", "rpm", "N·m"]


@settings(max_examples=40, deadline=None)
@given(data=st.binary(max_size=300))
def test_no_file_breaks_the_survey(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(data)
    try:
        found = survey_trace(path)
    except (CsvMisnamed, CsvUnusable):
        return
    assert len(found.names) == len(found.units)
    assert {one.column for one in found.guess} <= {*found.names, ""}


def test_each_offered_unit_can_be_chosen():
    for quantity in ("time", "speed", "torque"):
        for symbol in units_of(quantity):
            (choice,) = (one for one in parse_columns([f"{quantity}=x:{symbol}"]) if one.name)
            assert choice.unit is not None and choice.unit.symbol == symbol


def test_a_trace_written_as_a_log_is_the_same_recording(tmp_path):
    time_s = np.arange(0.0, 4.0, 0.01)
    rows = zip(time_s, 4.0 + np.sin(time_s), 90.0 + np.cos(time_s), strict=True)
    path = tmp_path / "trace.csv"
    path.write_text("time_s,speed_rad_s,torque_nm\n" + "".join(f"{a},{b},{c}\n" for a, b, c in rows))
    motion = tmp_path / "excitation.yaml"
    motion.write_text("segments: [{start_s: 0.0, periods: 3, period_s: 1.0, offset_rad_s: 4.0, lines_hz: [1.0]}]\n"
                      "levels: [{start_s: 0.0, end_s: 1.0}]\n")
    trace = read(path, excitation=motion, gear_ratio=2.0, torque_limit_nm=400.0)
    write_as_log(trace, tmp_path / "run.mcap", {"operator": "Anna"})
    log = read(tmp_path / "run.mcap")
    for name, value in vars(trace.recording).items():
        again = getattr(log.recording, name)
        assert np.array_equal(value, again) if isinstance(value, np.ndarray) else value == again, name
    assert (log.assumed, log.whole, log.problems) == (trace.assumed, True, ())
    assert log.configuration["operator"] == "Anna"
