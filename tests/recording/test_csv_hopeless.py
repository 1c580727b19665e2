"""Two hundred traces without information on J: each gives a typed error or a refusal, and never a number.

Each is a good trace of a rigid shaft (or random bytes) with one of many faults from a seed. The
excitation is known, so that identification continues as far as possible.
"""

import random
import tracemalloc
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdhil.errors import TdhilError, exit_code
from tdhil.estimation import identify
from tdhil.estimation.result import Verdict
from tdhil.recording.csv.excitation import load_excitation
from tdhil.recording.csv.layout import USUAL, parse_columns
from tdhil.recording.csv.reader import Bench, read_recording

HEAD = "time_s,speed_rad_s,torque_nm\n"
LINES = (0.1, 0.2, 0.3, 0.4)
PERIOD_S, PERIODS, RATE_HZ = 10.0, 5, 20.0
YAML = "segments:\n" + "".join(
    f"  - {{start_s: {n * PERIODS * PERIOD_S}, periods: {PERIODS}, period_s: {PERIOD_S}, offset_rad_s: {offset}, "
    f"lines_hz: {list(LINES)}}}\n" for n, offset in enumerate((4.0, 7.0)))
MOST_BYTES = 48 << 20


def sound(seed):
    """Return time, speed, torque (N,) with J 104 kg·m², B 8 N·m·s/rad, lags 0.4 and 0.15 s, two mean speeds."""
    rng = np.random.default_rng(seed)
    t = np.arange(2 * PERIODS * PERIOD_S * RATE_HZ) / RATE_HZ
    offset = np.where(t < PERIODS * PERIOD_S, 4.0, 7.0)
    s = 2j * np.pi * np.array(LINES)
    speed = np.array((1.5, 0.8, 0.25, 0.25)) * np.exp(1j * np.array((0.3, 1.7, 4.0, 5.1)))
    torque = (104.0 * s + 8.0) * (1 + 0.4 * s) / (1 + 0.15 * s) * speed
    turned = np.exp(np.outer(t, s))
    noise = 0.3 * rng.standard_normal(len(t))
    return t, offset + (turned @ speed).real, 60.0 + 8.0 * offset + (turned @ torque).real + noise


def table(t, w, m):
    return HEAD + "".join(f"{a:.4f},{b:.6f},{c:.5f}\n" for a, b, c in zip(t, w, m, strict=True))


# -- faults of a trace ------------------------------------------------------------------------------------------


def flat_speed(t, w, m, rng):
    return table(t, np.full_like(w, rng.uniform(-5, 5)), m)


def flat_torque(t, w, m, rng):
    return table(t, w, np.full_like(m, rng.uniform(-50, 50)))


def clipped_torque(t, w, m, rng):
    high = np.quantile(m, rng.uniform(0.5, 0.85))
    return table(t, w, np.minimum(m, high))


def clipped_speed(t, w, m, rng):
    return table(t, np.maximum(w, np.quantile(w, rng.uniform(0.2, 0.5))), m)


def without_values(t, w, m, rng):
    rows = table(t, w, m).splitlines(keepends=True)
    rows[1:] = [row.replace(row.split(",")[1], "NaN") if rng.random() < 0.9 else row for row in rows[1:]]
    return "".join(rows)


def shuffled(t, w, m, rng):
    order = list(range(len(t)))
    rng.shuffle(order)
    return table(t[order], w[order], m[order])


def twelve_samples(t, w, m, rng):
    return table(t[:12], w[:12], m[:12])


def cut_early(t, w, m, rng):
    count = rng.randrange(1, 380)
    return table(t[:count], w[:count], m[:count])


def noise_only(t, w, m, rng):
    own = np.random.default_rng(rng.getrandbits(32))
    return table(t, own.standard_normal(len(t)), 10 * own.standard_normal(len(t)))


def speed_for_torque(t, w, m, rng):
    return table(t, w, w)


def huge_numbers(t, w, m, rng):
    return table(t, w * 10.0 ** rng.randrange(20, 300), m)


def huge_field(t, w, m, rng):
    return table(t[:50], w[:50], m[:50]) + "9" * rng.randrange(10_000, 300_000) + ",1,2\n"


def long_line(t, w, m, rng):
    return HEAD + "1," * rng.randrange(50_000, 2_000_000)


def no_line_end(t, w, m, rng):
    return "x" * rng.randrange(100_000, 4_000_000)


def binary(t, w, m, rng):
    return rng.randbytes(rng.randrange(1, 50_000))


def flipped_bytes(t, w, m, rng):
    raw = bytearray(table(t[:100], w[:100], m[:100]).encode())
    for _ in range(200):
        raw[rng.randrange(len(raw))] = rng.randrange(256)
    return bytes(raw)


def binary_below(t, w, m, rng):
    return HEAD.encode() + rng.randbytes(20_000)


def words(t, w, m, rng):
    return HEAD + "".join(f"{a:.3f},{rng.choice(('on', 'off', '-', '###', '0x1F', '1_0', '1e'))},1\n" for a in t)


def repeated_times(t, w, m, rng):
    return table(np.floor(t / rng.uniform(0.5, 5)), w, m)


def absurd_times(t, w, m, rng):
    return table(t * 10.0 ** rng.randrange(4, 12), w, m)


def other_delimiter(t, w, m, rng):
    return table(t, w, m).replace(",", rng.choice("|: "))


def comma_for_point(t, w, m, rng):
    return HEAD + table(t, w, m).split("\n", 1)[1].replace(".", ",")


SPOILT = (flat_speed, flat_torque, clipped_torque, clipped_speed, without_values, shuffled, twelve_samples, cut_early,
          noise_only, speed_for_torque, huge_numbers, huge_field, long_line, no_line_end, binary, flipped_bytes,
          binary_below, words, repeated_times, absurd_times, other_delimiter, comma_for_point)


def end(path, excitation, choices=USUAL, bench=None):
    """Return the exit code of the error, or the identification. Any other exception is a bug."""
    try:
        recording, said = read_recording(path, choices, excitation, bench)
    except TdhilError as error:
        assert "\n" not in str(error) or excitation is not None
        assert str(path) in str(error) or "excitation.yaml" in str(error)
        return int(exit_code(error)), ()
    return identify(recording), said


def most_bytes(path):
    """Return the peak of memory while a trace is read or refused."""
    tracemalloc.start()
    try:
        with suppress(TdhilError):
            read_recording(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.fixture(scope="module")
def excitation(tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "excitation.yaml"
    path.write_text(YAML)
    return path


@pytest.mark.heavy
def test_the_good_trace_is_identified(tmp_path, excitation):
    path = tmp_path / "trace.csv"
    path.write_text(table(*sound(1)))
    found, said = end(path, excitation)
    assert found.verdict in (Verdict.VALID, Verdict.VALID_WIDE)
    assert found.inertia.low < 104.0 < found.inertia.high
    assert said == ()


@pytest.mark.long(but_first=10)
@pytest.mark.heavy
@pytest.mark.parametrize("spoil", SPOILT, ids=lambda spoil: spoil.__name__)
def test_a_faulty_trace_gives_no_number(tmp_path, excitation, spoil):
    path = tmp_path / "trace.csv"
    for seed in range(2 if spoil is speed_for_torque else 10):       # only this one reaches a fit
        content = spoil(*sound(seed), random.Random(seed))
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        if seed == 0:
            assert most_bytes(path) < MOST_BYTES
        found, _ = end(path, excitation)
        if isinstance(found, int):
            assert found in (2, 10), seed
        else:
            assert found.verdict in (Verdict.NOT_IDENTIFIABLE, Verdict.MODEL_REJECTED), (seed, found)
            assert found.inertia is None, seed
            assert found.reason, seed


def test_a_torque_limit_that_was_reached_is_refused(tmp_path, excitation):
    path = tmp_path / "trace.csv"
    t, w, m = sound(1)
    path.write_text(table(t, w, m))
    found, _ = end(path, excitation, bench=Bench(torque_limit_nm=float(np.quantile(m, 0.98))))
    assert found.verdict is Verdict.NOT_IDENTIFIABLE
    assert "limit" in found.reason


CELLS = st.one_of(
    st.floats(width=32).map(str), st.integers(-99, 99).map(str), st.text(max_size=6),
    st.sampled_from(["", "NaN", '"', '"1,5"', "1,5", "1.5", "12:00:00.5", "2024-05-01T12:00:00", "rpm", "1.234,5"]))
NAMES = st.sampled_from(["time_s", "speed_rad_s", "torque_nm", "time", "Speed [rpm]", "torque_pct", "n", ""])


@pytest.mark.heavy
@settings(max_examples=150)
@given(
    names=st.lists(NAMES, min_size=2, max_size=5), rows=st.lists(st.lists(CELLS, max_size=5), max_size=12),
    delimiter=st.sampled_from(",;\t"), encoding=st.sampled_from(["utf-8", "utf-16", "latin-1"]),
    chosen=st.booleans(),
)
def test_any_table_ends_in_a_typed_error_or_a_refusal(tmp_path_factory, names, rows, delimiter, encoding, chosen):
    path = Path(tmp_path_factory.getbasetemp()) / "any.csv"
    text = "\n".join(delimiter.join(row) for row in [names, *rows])
    path.write_bytes(text.encode(encoding, errors="replace"))
    choices = parse_columns(["speed=n:rpm"]) if chosen else USUAL
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found, _ = end(path, None, choices, Bench(rated_torque_nm=100.0))
    assert found in (2, 10) if isinstance(found, int) else found.inertia is None


YAML_WRONG = {
    "periods: 3, end_s: 30": ("excitation.yaml:2", "either periods or end_s"),
    "periods: 1": ("excitation.yaml:2", "1 whole periods"),
    "periods: 9, lines_hz: [0.11]": ("not a whole number",),
    "periods: 9, lines_hz: [0.1, 0.1]": ("twice",),
    "periods: 9, amplitudes_rad_s: [1.0]": ("1 numbers for 2 lines",),
    "periods: 9, line_hz: [0.1]": ("did you mean", "lines_hz"),
    "periods: 9, start_s: 1000.0": ("segment 1 lasts from 1000 to", "trace from 0 to 99.95"),
    "periods: 9, period_s: -1.0": ("period_s",),
    "end_s: 1e12": ("whole periods",),
}


@pytest.mark.parametrize("keys", YAML_WRONG)
def test_a_wrong_excitation_is_reported_with_its_line(tmp_path, keys):
    given_keys = dict(part.split(": ", 1) for part in keys.replace(", 0.1]", "; 0.1]").split(", "))
    defaults = {"start_s": "0.0", "period_s": "10.0", "offset_rad_s": "4.0", "lines_hz": "[0.1, 0.2]"}
    text = "segments:\n  - {" + ", ".join(f"{k}: {v}" for k, v in (defaults | given_keys).items()) + "}\n"
    path = tmp_path / "excitation.yaml"
    path.write_text(text.replace(";", ","))
    with pytest.raises(TdhilError) as caught:
        load_excitation(path, sound(1)[0])
    assert exit_code(caught.value) == 2
    for word in YAML_WRONG[keys]:
        assert word in str(caught.value)
