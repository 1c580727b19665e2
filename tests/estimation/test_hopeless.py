"""Two hundred malformed or unusable records: no number without a warning, no exception and no Python warning.

They are three of each family of `hopeless_families`, and twenty with two faults. About eighty run without --long,
and six of these with --heavy. Some also run as a CSV through the command line. An accepted number must have
a warning, and an interval that covers (at 99.9 %, to exclude chance).
"""

import contextlib
import io
import json
import zlib

import numpy as np
import pytest
import yaml

from tdhil.cli.main import main
from tdhil.estimation import Options, Verdict, identify
from tests.estimation.hopeless_families import FAMILIES
from tests.estimation.hopeless_shaft import INERTIA, Trouble, simulate

pytestmark = pytest.mark.one_worker

REFUSED = (Verdict.NOT_IDENTIFIABLE, Verdict.MODEL_REJECTED)
EACH = 3
CASES = [(one, number) for one in FAMILIES for number in range(20 if one.name == "two_faults" else EACH)]
LEAST = 200


def stream(one, number):
    return np.random.default_rng((zlib.crc32(one.name.encode()), number))


@pytest.fixture(scope="module")
def records():
    """Return the records by family and number. All faults of the shaft are simulated in one batch."""
    streams = {(one.name, number): stream(one, number) for one, number in CASES}
    troubles = [one.trouble(streams[one.name, number]) for one, number in CASES]
    kinds = list(dict.fromkeys(troubles))
    made = dict(zip(kinds, simulate(kinds, 9), strict=True))
    with np.errstate(all="ignore"):
        return {
            (one.name, number): made[trouble] if one.spoil is None
            else one.spoil(made[trouble], streams[one.name, number])
            for (one, number), trouble in zip(CASES, troubles, strict=True)
        }


def test_there_are_enough_records():
    assert len(CASES) >= LEAST
    assert len({one.name for one in FAMILIES}) == len(FAMILIES)


def left_out(one, number):
    if one.name != "two_faults":
        return pytest.mark.long if number else ()
    return pytest.mark.long if str(number)[0] == "1" else pytest.mark.heavy if number > 3 else ()


@pytest.mark.heavy
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("one", "number"), [
    pytest.param(one, number, id=f"{one.name}-{number}", marks=left_out(one, number)) for one, number in CASES
])
def test_never_a_number_without_a_warning(records, one, number):
    found = identify(records[one.name, number], Options(confidence=0.999))
    said = " ".join((found.reason, found.advice, *found.warnings))
    if found.inertia is None:
        assert found.verdict in REFUSED
        assert found.reason
        assert found.advice
    else:
        assert found.warnings, said
        assert found.inertia.low <= INERTIA <= found.inertia.high, (found.inertia, said)
    assert not one.said or any(words in said for words in one.said), said


@pytest.mark.heavy
@pytest.mark.filterwarnings("error")
def test_the_good_record_has_a_number_and_no_warning():
    for record in simulate([Trouble()] * 4, 4):
        found = identify(record, Options(confidence=0.999))
        assert found.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
        assert found.inertia.low <= INERTIA <= found.inertia.high
        assert not any(words in said for said in found.warnings for words in ("drifting", "undeclared", "left out"))


@pytest.mark.heavy
@pytest.mark.filterwarnings("error")
def test_one_tone_with_unknown_lags_is_not_identifiable(records):
    for number in range(EACH):
        found = identify(records["one_tone", number])
        assert found.verdict is Verdict.NOT_IDENTIFIABLE
        assert "equations" in found.reason


# -- through a CSV and the command line ----------------------------------------------------------------------

CSV = (
    "flat_speed", "flat_torque", "all_zero", "noise_alone", "one_tone", "torque_clipped", "speed_clipped_softly",
    "many_nan", "many_infinite", "huge", "spiked", "rows_shuffled", "time_repeats", "time_backwards",
    "time_not_a_number", "values_shuffled", "milliseconds", "microseconds", "kiloseconds", "clock_wrong",
    "next_to_nothing", "cut_early", "feedback_stuck", "torque_reversed", "columns_exchanged",
    "no_excitation_and_no_motion", "other_lines", "elsewhere", "overlapping", "thinned", "stick_slip",
    "torque_zero_wanders",
)


@pytest.mark.long(but_first=12)
@pytest.mark.heavy
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CSV)
def test_as_a_trace_it_ends_in_one_clear_sentence(records, tmp_path, name):
    record = records[name, 0]
    trace, excitation = tmp_path / "trace.csv", tmp_path / "excitation.yaml"
    rows = zip(record.time_s, record.speed_rad_s, record.torque_nm, strict=True)
    trace.write_text("time_s,speed_rad_s,torque_nm\n" + "".join(f"{t:.6g},{w:.7g},{m:.7g}\n" for t, w, m in rows))
    arguments = ["replay", str(trace), "--json"]
    if record.excitation is not None and record.excitation.segments:
        excitation.write_text(yaml.safe_dump({"segments": [
            {"start_s": s.start_s, "end_s": s.end_s, "period_s": s.period_s, "offset_rad_s": s.offset_rad_s,
             "lines_hz": list(s.lines_hz)} for s in record.excitation.segments
        ]}))
        arguments += ["--excitation", str(excitation)]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments)
    assert "Traceback" not in out.getvalue() + err.getvalue()
    if code in (2, 10):
        assert "tdhil:" in err.getvalue()
        return
    document = json.loads(out.getvalue())
    assert err.getvalue() == ""
    if code == 9:
        assert document["inertia_kg_m2"] is None
        assert document["reason"]
        assert "\n" not in document["reason"]
    else:
        assert code == 0
        # every trace has one warning, about the assumed torque scale
        assert len(document["warnings"]) >= 2
