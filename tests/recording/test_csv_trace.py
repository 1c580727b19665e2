"""Exports of drive tools: each is read with its stated meaning, or refused with one line that names the place."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdhil.errors import CsvMisnamed, CsvUnusable, ExitCode, UsageError, exit_code
from tdhil.recording.csv import reader as csv_trace
from tdhil.recording.csv import text as csv_text
from tdhil.recording.csv.layout import USUAL, parse_columns
from tdhil.recording.csv.reader import read_trace, resolution
from tdhil.recording.csv.text import ClockReader

RPM = 2.0 * math.pi / 60.0
FOOT_POUND = 1.3558179483314004
NAMED = ("time=t_s", "speed=n_rpm:rpm", "torque=m_pct:%")

# name: (text, encoding, columns, rated torque, times, speeds, torques, words of the warnings)
EXPORTS = {
    "plain": ("time_s,speed_rad_s,torque_nm\n0,1.5,10\n0.01,1.6,-11\n", "utf-8", (), None,
              [0, 0.01], [1.5, 1.6], [10, -11], ()),
    "other order, other case, more columns": (
        "Status,TORQUE_NM,Time_S,Speed_Rad_S,Note\nrun,10,0,1.5,a\nrun,11,0.01,1.6,\n", "utf-8", (), None,
        [0, 0.01], [1.5, 1.6], [10, 11], ()),
    "the issue's own": ("t_s,n_rpm,m_pct\n0,60,50\n0.004,61,-25\n", "utf-8", NAMED, 480.0,
                        [0, 0.004], [60 * RPM, 61 * RPM], [240, -120], ()),
    "UTF-8 with a mark, CR LF": ("time_s;speed_rad_s;torque_nm\r\n0;1;2\r\n1;2;3\r\n", "utf-8-sig", (), None,
                                 [0, 1], [1, 2], [2, 3], ()),
    "UTF-16": ("time_s\tspeed_rad_s\ttorque_nm\r\n0\t1\t2\r\n1\t2\t3\r\n", "utf-16", (), None,
               [0, 1], [1, 2], [2, 3], ()),
    "German, Latin-1, units below, metadata above": (
        "sep=;\nGerät;Umrichter 7\nDatum;01.05.2024 12:00\n\nZeit;Drehzahl;Moment\n[ms];[U/min];[N·m]\n"
        "0;60,0;1.234,5\n1,5;61,5;-12,25\n", "latin-1",
        ("time=Zeit", "speed=drehzahl", "torque=MOMENT"), None,
        [0, 0.0015], [60 * RPM, 61.5 * RPM], [1234.5, -12.25], ("Windows-1252", "decimal comma")),
    "decimal commas in quotes": ('time_s,speed_rad_s,torque_nm\n"0,0","1,5","2,5"\n"0,1","1,6","2,6"\n', "utf-8", (),
                                 None, [0, 0.1], [1.5, 1.6], [2.5, 2.6], ("decimal comma",)),
    "thousands in quotes": ('time_s,speed_rad_s,torque_nm\n0.0,1.5,"1,234.5"\n0.1,1.6,"-2,000.0"\n', "utf-8", (), None,
                            [0, 0.1], [1.5, 1.6], [1234.5, -2000], ()),
    "units in brackets": ("Time [us],Speed [1/min],Torque [‰]\n0,60,500\n250,61,-1000\n", "utf-8", (), 480.0,
                          [0, 0.00025], [60 * RPM, 61 * RPM], [240, -480], ()),
    "units in names": ("time_ms,speed_deg_s,torque_knm\n0,180,1\n4,90,-0.5\n", "utf-8", (), None,
                       [0, 0.004], [math.pi, math.pi / 2], [1000, -500], ()),
    "milli and kilo, by case": ("time_s,speed_rad_s,Torque [mN·m]\n0,1,1500\n1,2,-20\n", "utf-8", (), None,
                                [0, 1], [1, 2], [1.5, -0.02], ()),
    "a setpoint beside the actual value": (
        "time_s,speed_setpoint_rpm,speed_rpm,torque_limit_nm,torque_actual_nm\n0,90,60,500,2\n1,90,61,500,3\n", "utf-8",
        ("torque=torque_actual_nm",), None, [0, 1], [60 * RPM, 61 * RPM], [2, 3], ()),
    "a setpoint by its name": ("time_s,speed_rad_s,torque_target_nm\n0,1,2\n1,2,3\n", "utf-8",
                               ("torque=torque_target_nm",), None, [0, 1], [1, 2], [2, 3],
                               ("'torque_target_nm' is a setpoint, a limit or an error by its name",)),
    "a unit that is told": ("time_s,speed_rad_s,Torque [% Mn]\n0,1,50\n1,2,10\n", "utf-8", ("torque=Torque:%",), 480.0,
                            [0, 1], [1, 2], [240, 48], ()),
    "letters of axes and phases, and SI before other words": (
        "time_s,speed_w,m_nm_filtered\n0,1,2\n1,2,3\n", "utf-8", ("speed=speed_w", "torque=m_nm_filtered"), None,
        [0, 1], [1, 2], [2, 3], ("rad/s was assumed", "N·m was assumed")),
    "a current that is told to be a torque": (
        "time_s,speed_rad_s,I_A\n0,1,2\n1,2,3\n", "utf-8", ("torque=I_A:Nm",), None, [0, 1], [1, 2], [2, 3], ()),
    "speed in 1/min, not the least speed": ("time_s,speed_1/min,torque_nm\n0,60,2\n1,61,3\n", "utf-8", (), None,
                                            [0, 1], [60 * RPM, 61 * RPM], [2, 3], ()),
    "seconds that are told": ("t,w_rad_s,m_nm\n0,1,2\n1,2,3\n", "utf-8", ("time=t:s", "speed=w_rad_s", "torque=m_nm"),
                              None, [0, 1], [1, 2], [2, 3], ()),
    "feet and turns": ("a;b;c\nmin;1/s;lbf·ft\n0;1;1\n1;2;-2\n", "utf-8", ("time=a", "speed=b", "torque=c"), None,
                       [0, 60], [2 * math.pi, 4 * math.pi], [FOOT_POUND, -2 * FOOT_POUND], ("revolutions a second",)),
    "Hz, told to be turns": ("time_s;freq_hz;torque_nm\n0;1;1\n1;2;-2\n", "utf-8", ("speed=freq_hz:Hz",), None,
                             [0, 1], [2 * math.pi, 4 * math.pi], [1, -2], ("revolutions of the shaft a second",)),
    "units that nobody states": ("t,w,m\n0,1,2\n0.5,2,3\n", "utf-8", ("time=t", "speed=w", "torque=m"), None,
                                 [0, 0.5], [1, 2], [2, 3], ("s was assumed", "rad/s was assumed", "N·m was assumed")),
    "told otherwise than the file says": (
        "time_s,n_rpm,torque_nm\n0,1,2\n1,2,3\n", "utf-8", ("speed=n_rpm:rad/s",), None,
        [0, 1], [1, 2], [2, 3], ("the file says rpm",)),
    "time stamps": (
        "time;speed_rad_s;torque_nm\n2024-05-01T23:59:59.990;1;2\n2024-05-02T00:00:00.000Z;2;3\n", "utf-8", (), None,
        [0, 0.01], [1, 2], [2, 3], ("clock times",)),
    "clock over midnight": ("time;speed_rad_s;torque_nm\n23:59:59,5;1;2\n0:00:00,25;2;3\n", "utf-8", (), None,
                            [0, 0.75], [1, 2], [2, 3], ("clock times",)),
    "cells without a value": (
        "time_s,speed_rad_s,torque_nm\n0,1,2\n1,NaN,3\n2,,3\n3,#N/A,3\n,1,1\n4,2,3\n5,inf,3\n6,3.4e38,0\n", "utf-8", (),
        None, [0, 4], [1, 2], [2, 3], ("3: 5 rows were dropped: no value", "9: 1 row was dropped: a number beyond")),
    "blank and ragged lines": (
        "time_s,speed_rad_s,torque_nm\n\n0,1,2\n   \n1,2,3,\n2,3\n" + "".join(f"{n},1,2\n" for n in range(3, 30)),
        "utf-8", (), None, list(range(2)) + list(range(3, 30)), [1, 2] + [1] * 27, [2, 3] + [2] * 27,
        ("6: 1 row was dropped: cells missing",)),
    "a time twice, one too high, one back, a gap": (
        "time_s,speed_rad_s,torque_nm\n" + "".join(
            f"{t},{t},1\n" for t in [*range(12), 11, 12, 13, 99, 14, 3, *range(15, 40), 60, 61]), "utf-8", (), None,
        [*range(40), 60, 61], [*range(40), 60, 61], [1] * 42,
        ("3 rows were dropped, where the time repeats itself", "1 gap")),
    "a channel that starts late": (
        "time_s,speed_rad_s,torque_nm\n" + "".join(f"{n},,\n" for n in range(9)) + "9,1,2\n10,2,3\n", "utf-8", (), None,
        [9, 10], [1, 2], [2, 3], ("2: 9 rows were dropped: no value",)),
    "decimal commas after a long standstill": (
        "time_s;speed_rad_s;torque_nm\n" + "".join(f"{n};0;0\n" for n in range(6000)) + "6000,5;1,5;2\n", "utf-8", (),
        None, [*range(6000), 6000.5], [0] * 6000 + [1.5], [0] * 6000 + [2], ("decimal comma",)),
    "old line ends": ("time_s,speed_rad_s,torque_nm\r0,1,2\r1,2,3\r", "utf-8", (), None, [0, 1], [1, 2], [2, 3], ()),
    "NULs of a power failure": ("time_s,speed_rad_s,torque_nm\n0,1,2\n1,2,3\n" + 2000 * "\0", "utf-8", (), None,
                                [0, 1], [1, 2], [2, 3], ()),
    "a name with a colon": ("Time;Axis 1: n;Axis 1: M\ns;rpm;Nm\n0;60;2\n1;60;3\n", "utf-8",
                            ("time=Time", "speed=Axis 1: n", "torque=axis 1: m:Nm"), None,
                            [0, 1], [60 * RPM] * 2, [2, 3], ()),
}


@pytest.mark.parametrize("name", EXPORTS)
def test_an_export_is_read_with_its_stated_meaning(tmp_path, name):
    text, encoding, columns, rated, times, speeds, torques, words = EXPORTS[name]
    path = tmp_path / "trace.csv"
    path.write_bytes(text.encode(encoding))
    trace = read_trace(path, parse_columns(columns) if columns else USUAL, rated)
    np.testing.assert_allclose(trace.time_s, times, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(trace.speed_rad_s, speeds, rtol=1e-12)
    np.testing.assert_allclose(trace.torque_nm, torques, rtol=1e-12)
    said = "\n".join(trace.warnings)
    for word in words:
        assert word in said
    assert len(trace.warnings) == len(words), said


HEAD = "time_s,speed_rad_s,torque_nm\n"
ROWS = "".join(f"{n},{n % 7},{n % 5}\n" for n in range(100))
REFUSED = {
    # name: (content, columns, exit code, words of the one line)
    "empty": ("", (), 10, "trace.csv: the file is empty"),
    "no table": ("hello\nworld\n", (), 10, "there is no table"),
    "header only": (HEAD, (), 10, "trace.csv:1: no numbers"),
    "no header": (ROWS, (), 2, "no header"),
    "misspelt": ("t_s,n_rpm,m\n0,1,2\n", ("time=t_s", "speed=n_rmp:rpm", "torque=m"), 2, "did you mean 'n_rpm'?"),
    "misspelt, usual": ("time_s,sped_rad_s,torque_nm\n0,1,2\n", (), 2, "trace.csv:1: no column is called speed"),
    "twice": ("time_s,n,n,torque_nm\n0,1,2,3\n", ("speed=n",), 2, "2 columns could be speed"),
    "unknown unit below": ("time_s,n,torque_nm\ns,furlong,Nm\n0,1,2\n", ("speed=n",), 2, "is not a unit of speed"),
    "unknown unit in the name": ("time_s,speed_rad_s,Torque [% Mn]\n0,1,2\n", (), 2,
                                 "'% Mn', of column 'Torque [% Mn]', is not a unit of torque; use N·m, mN·m"),
    "unknown unit of the speed": ("time_s,Speed [0.1 rpm],torque_nm\n0,1,2\n", (), 2,
                                  "state this unit behind a colon: --columns speed='Speed [0.1 rpm]:…'"),
    "mega and not milli": ("time_s,speed_rad_s,torque [MNm]\n0,1,2\n", (), 2, "is not a unit of torque"),
    "unknown units below": ("time,speed,torque\n[tick],[inc],[1/1000 Mn]\n0,1,2\n", (), 2,
                            "is not a unit of time"),
    **{f"only a setpoint: {name}": (f"time_s,speed_rad_s,{name}\n0,1,2\n", (), 2,
                                    f"no column holds the actual torque. By name, '{name}' is a setpoint, a limit or "
                                    "an error")
       for name in ("torque_limit_nm", "torque_setpoint_nm", "Torque demand [Nm]", "torque_cmd_%", "target torque [Nm]",
                    "TorqueRef [Nm]", "Solltorque [Nm]")},
    **{f"a current: {name}": (f"time_s,speed_rad_s,{name}\n0,1,2\n", (f"torque={name}",), 2,
                              "A current is not a torque. Convert the column with the torque constant of the motor")
       for name in ("I_A", "current_a", "I [A]", "motor current [mA]", "iq_amps")},
    **{f"not a unit of torque: {name}": (f"time_s,speed_rad_s,{name}\n0,1,2\n", (f"torque={name}",), 2,
                                         "is not a unit of torque; use N·m")
       for name in ("torque_pu", "torque_percent_of_rated", "torque_in_lb", "m_mnm", "torque_rpm", "m_knm_filtered")},
    **{f"not a unit of speed: {name}": (f"time_s,{name},torque_nm\n0,1,2\n", (f"speed={name}",), 2,
                                        "is not a unit of speed; use rad/s")
       for name in ("speed_pct", "v_m_s", "speed_counts", "speed_rpm_x10")},
    **{f"Hz: {text[:22]}": (text, ("time=t", "speed=n", "torque=m"), 2, "is a frequency. The output frequency of an "
                            "inverter is that of the stator")
       for text in ("t;n [Hz];m\n0;1;2\n", "t;n;m\ns;Hz;Nm\n0;1;2\n", "t;n;m\n;Hz;\n0;1;2\n")},
    "Hz in the name": ("time_s,speed_hz,torque_nm\n0,1,2\n", ("speed=speed_hz",), 2,
                       "state Hz behind a colon: --columns speed='speed_hz:Hz'"),
    **{f"a time without a unit: {name}": (
        "time,speed_rad_s,torque_nm\n" + "".join(f"{step * n},1,2\n" for n in range(9)), (), 2,
        f"usual step is {step}. It may count milliseconds or samples. State its unit: --columns time='time:ms'")
       for name, step in (("samples", 1), ("ms", 4), ("µs", 250))},
    "units at odds": ("time_s,n_rpm,torque_nm\ns,rad/s,Nm\n0,1,2\n", ("speed=n_rpm",), 2, "rpm by its name but rad/s"),
    "per cent of nothing": ("time_s,speed_rad_s,torque_pct\n0,1,2\n", (), 2, "--rated-torque"),
    "decimal commas between commas": (HEAD + "0,0,1,5,2,5\n" * 50, (), 10, "decimal commas the separator must be"),
    "both decimal signs": ("time_s;speed_rad_s;torque_nm\n0;1,5;2.5\n", (), 10, "trace.csv:2: some numbers have"),
    "thousands or decimals, in one column": (
        "Zeit [ms];n [1/min];M [Nm]\n0;1.198;70\n10;1.206;73\n", ("time=Zeit", "speed=n", "torque=M"), 10,
        "trace.csv:2: the point in '1.198', of column 'n [1/min]', may be a decimal sign or may separate thousands"),
    "thousands beside integers": (
        "time_ms;speed_rpm;torque_nm\n0;998;70.125\n10;1.002;71.375\n", (), 10, "the point in '1.002', of column"),
    "thousands after a long standstill": (
        "time_ms;speed_rpm;torque_nm\n" + "".join(f"{n};0;5\n" for n in range(6000)) + "6000;1.002;5\n", (), 10,
        "the point in '1.002', of column 'speed_rpm'"),
    "English thousands between tabs": (
        "time_ms\tspeed_rpm\ttorque_nm\n0\t1,198\t70\n10\t1,206\t73\n", (), 10,
        "the comma in '1,198', of column 'speed_rpm'"),
    "words for numbers": (HEAD + ROWS + "1,a,b\n" * 50, (), 10, "trace.csv:102: 50 rows have something else"),
    "shuffled": (HEAD + "".join(f"{n * 37 % 101},1,2\n" for n in range(101)), (), 10, "the time goes back"),
    "too coarse": (HEAD + "".join(f"{n // 10},1,2\n" for n in range(200)), (), 10, "the time repeats itself"),
    "weeks": (HEAD + ROWS + "1e9,1,2\n", (), 10, "trace.csv:102: the time spans 1e+09 s"),
    "too many columns": (",".join(f"c{n}" for n in range(600)) + "\n", (), 10, "more than 512 columns"),
    "header too far down": ("#,\n" * 50 + HEAD + ROWS, (), 2, "no header"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_unreadable_export_is_refused_in_one_line(tmp_path, name):
    content, columns, code, words = REFUSED[name]
    path = tmp_path / "trace.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises((CsvMisnamed, CsvUnusable, UsageError)) as caught:
        read_trace(path, parse_columns(columns) if columns else USUAL)
    message = str(caught.value)
    assert words in message
    assert ":N·m'" not in message and ":rad/s'" not in message      # an example is copied, although the unit is another
    assert message.startswith(str(path))
    assert "\n" not in message
    assert exit_code(caught.value) == code


@pytest.mark.parametrize("head", [b"PK\x03\x04....", b"\x1f\x8b\x08\x00", bytes(range(256)) * 20, b"\0" * 500,
                                  "time,speed,torque\n1,2,3\n".encode("utf-32")])
def test_a_file_that_is_no_text_is_reported(tmp_path, head):
    path = tmp_path / "trace.csv"
    path.write_bytes(head)
    with pytest.raises(CsvUnusable, match=r"no text|neither text"):
        read_trace(path)


@pytest.mark.parametrize(("item", "words"), [
    ("speed", "is not quantity=column"), ("sped=n", "did you mean 'speed'?"), ("torque=", "is not quantity=column"),
    ("speed=n:furlong", "not a unit of speed"), ("speed=n:Nm", "not a unit of speed"),
    ("torque=:Nm", "not a unit of torque"),
])
def test_a_wrong_choice_of_columns_is_a_usage_error(item, words):
    with pytest.raises(UsageError, match=words) as caught:
        parse_columns(["time=t", item])
    assert exit_code(caught.value) is ExitCode.USAGE


def test_files_rows_and_lines_have_a_limit(tmp_path, monkeypatch):
    path = tmp_path / "trace.csv"
    path.write_text(HEAD + ROWS)
    monkeypatch.setattr(csv_trace, "MAX_ROWS", 40)
    trace = read_trace(path)
    assert len(trace.time_s) == 40
    assert "trace.csv:42: more than 40 rows" in trace.warnings[0]
    monkeypatch.setattr(csv_text, "MAX_BYTES", 400)
    with pytest.raises(CsvUnusable, match="larger than"):
        read_trace(path)
    monkeypatch.undo()
    path.write_text(HEAD + ROWS + "1," * csv_text.MAX_LINE)
    with pytest.raises(CsvUnusable, match=r"trace.csv:102: a line of more than 65536"):
        read_trace(path)


@pytest.mark.parametrize("rate_hz", [50.0, 1000.0])
@settings(max_examples=15, deadline=None)
@given(at=st.integers(200, 1700), back=st.integers(2, 150))
def test_a_clock_that_is_set_back_leaves_a_gap(tmp_path_factory, rate_hz, at, back):
    """Time, speed and torque are one on both sides of the gap, and no row of the wrong time is beside a right one."""
    number = np.arange(2000)
    stamps = (number - np.where(number < at, 0, back)) / rate_hz
    path = tmp_path_factory.getbasetemp() / "clock.csv"
    path.write_text(HEAD + "".join(f"{t:.4f},{n},1\n" for t, n in zip(stamps, number, strict=True)))
    trace = read_trace(path)
    said, gap = trace.warnings
    assert f":{at + 2}: " in said
    assert f"where the time goes back by {(back - 1) / rate_hz:.3g} s; a gap was left" in said
    assert "1 gap in the time" in gap
    steps = np.diff(trace.time_s)
    (seam,) = np.flatnonzero(np.diff(trace.speed_rad_s) > 1.0)
    assert steps[seam] >= max(0.1, 5.0 / rate_hz)
    assert trace.speed_rad_s[seam] == at - 1 and np.all(np.delete(steps, seam) < 1.5 / rate_hz)


def test_a_single_time_out_of_order_leaves_no_gap(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text(HEAD + "".join(f"{n if n != 40 else 7},{n},1\n" for n in range(100)))
    (said,) = read_trace(path).warnings
    assert said.endswith("1 row was dropped, where the time goes back by 32 s")


@pytest.mark.parametrize("odd", ["", "200.5,NaN,1", "200.5,x,1", "200.5", '"200.5","1","2"'])
def test_blocks_and_single_rows_read_alike(tmp_path, monkeypatch, odd):
    """The result is the same for any block size, and for blocks read at once or row by row."""
    path = tmp_path / "trace.csv"
    rows = [f"{n},{n % 7}.25,{n % 5}" for n in range(400)]
    path.write_text("\n".join([HEAD.strip(), *rows[:201], odd, *rows[201:]]))
    whole = read_trace(path)
    monkeypatch.setattr(csv_text, "_BLOCK", 97)
    pieces = read_trace(path)
    np.testing.assert_array_equal(whole.time_s, pieces.time_s)
    np.testing.assert_array_equal(whole.speed_rad_s, pieces.speed_rad_s)
    assert whole.warnings == pieces.warnings


@pytest.mark.parametrize(("cells", "seconds"), [
    (("1:00:00 PM", "1:00:01.5 p.m."), (46800, 46801.5)), (("12:00:00 AM", "12:00:01 AM"), (0, 1)),
    (("01.05.2024 10:00:00", "02.05.2024 10:00:00"), (36000, 122400)),
    (("5/1/2024 10:00:00", "05-01-24 10:00:00"), (None, None)),       # day and month are ambiguous
    (("2024-05-01 10:00:00+02:00", "2024-05-01 10:00:00+01:00"), (28800, 32400)),
    (("00:12.3", "00:12.4"), (12.3, 12.4)), (("12:30", "25:61:00"), (None, None)),
    (("2024-13-01 10:00:00", "10:00:00:5"), (None, None)), (("10:00:00", "10:00:"), (36000, None)),
])
def test_times_of_day(cells, seconds):
    reader = ClockReader()
    assert [reader.seconds(cell) for cell in cells] == [pytest.approx(s) if s is not None else None for s in seconds]


def test_resolution_is_the_count_of_a_rounded_signal():
    wave = np.sin(np.linspace(0.0, 20.0, 5000))
    assert resolution(np.round(wave, 1) * RPM) == pytest.approx(0.1 * RPM)
    assert resolution(wave) < 1e-3
    assert resolution(np.ones(5)) == 0.0


def grouped(number, sign):
    return f"{number:,}".replace(",", sign)


def outcome(folder, cells, *, delimiter=";", head=("time_ms", "speed_rpm", "torque_nm")):
    """Return the speed and torque of a table as they are read, in rpm and N·m, or 'refused'."""
    path = folder / "any.csv"
    path.write_text("\n".join(delimiter.join(row) for row in [head, *cells]) + "\n", encoding="utf-8")
    try:
        trace = read_trace(path)
    except CsvUnusable as error:
        assert "may separate thousands" in str(error)
        return "refused"
    return trace.speed_rad_s / RPM, trace.torque_nm


@settings(max_examples=60, deadline=None)
@given(speeds=st.lists(st.integers(-30_000, 30_000), min_size=2, max_size=8),
       torques=st.lists(st.integers(-999, 999), min_size=8, max_size=8), swapped=st.booleans(),
       sign=st.sampled_from(".,"), delimiter=st.sampled_from(";\t"))
def test_a_whole_number_with_thousands_is_never_read_as_a_thousandth(tmp_path_factory, speeds, torques, swapped, sign,
                                                                     delimiter):
    speeds = [*speeds, 1200]
    rows = [(str(10 * n), *([grouped(speed, sign), str(torque)][::-1 if swapped else 1]))
            for n, (speed, torque) in enumerate(zip(speeds, torques, strict=False))]
    rows.append((str(10 * len(rows)), *([grouped(1200, sign), "5"][::-1 if swapped else 1])))
    assert outcome(tmp_path_factory.getbasetemp(), rows, delimiter=delimiter) == "refused"


# name: format of the time in ms, of the speed and of the torque
DECIMALS = {"three decimals in both": ("{:.0f}", "{:.3f}", "{:.3f}"), "in all": ("{:.3f}", "{:.3f}", "{:.3f}"),
            "another number of decimals in one": ("{:.0f}", "{:.3f}", "{:.2f}"),
            "more decimals": ("{:.0f}", "{:.4f}", "{:.0f}")}


@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("name", DECIMALS)
@settings(max_examples=25, deadline=None)
@given(values=st.lists(st.tuples(st.floats(1.0, 999.0), st.floats(-999.0, 999.0)), min_size=2, max_size=8))
def test_a_fixed_number_of_decimals_is_read(tmp_path_factory, name, comma, values):
    rows = [[text.format(value) for text, value in zip(DECIMALS[name], (2000.0 + 10.0 * n, *pair), strict=True)]
            for n, pair in enumerate(values)]
    written = np.array([[float(cell) for cell in row] for row in rows])
    if comma:
        rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    found = outcome(tmp_path_factory.getbasetemp(), rows)
    assert found != "refused"
    np.testing.assert_allclose(np.transpose(found), written[:, 1:], rtol=1e-9)


@pytest.mark.parametrize("rows", [
    [("12.340", "1.198", "70"), ("12.350", "1.206", "73")],       # a time in s is no whole number of seconds
    [("0", "0.125", "70"), ("10", "1.125", "73")], [("0", "1.198", "70"), ("10", "1.2", "73")],
    [("0", "1200", "70"), ("10", "1.206", "73")],                 # this column has no signs between thousands
])
def test_three_decimals_beside_whole_numbers_are_read_if_one_cell_shows_the_sign(tmp_path, rows):
    head = ("time_s" if "." in rows[0][0] else "time_ms", "speed_rpm", "torque_nm")
    speed, _ = outcome(tmp_path, rows, head=head)
    np.testing.assert_allclose(speed, [float(row[1]) for row in rows], rtol=1e-9)
