"""Judge of a run with false reports: each rule on traces made by hand, and the set of runs."""

import errno
from dataclasses import replace

import numpy as np
import pytest

from sim_bus.lying_runs import PROGRAMS, UNKNOWABLE, product, sample, standard, unknowable
from sim_bus.reports import LIES
from sim_bus.shaft_judge import JudgedMachine, ProcessOutcome, TrueShaft, judge, outcome_of, read_shaft
from sim_bus.trace import HEADER, INCOMPLETE, ShaftTrace

RIG = JudgedMachine(100.0, 20.0, 380.0, 10.0, string=False)
FINE = ProcessOutcome(0, True, 20.0, "valid", 95.0, 105.0, removed=False, log_closed=True)


def shaft(speeds, *, disabled_s=(20.0,), stop_s=10.0):
    """Return a shaft with the speed interpolated between (time, speed), every 10 ms up to 30 s."""
    time_s = np.arange(0.0, 30.0, 0.01)
    speed = np.interp(time_s, [t for t, _ in speeds], [w for _, w in speeds])
    return TrueShaft(time_s, speed, np.zeros_like(time_s), time_s < 20.0, disabled_s, stop_s)


TURNED = shaft([(0, 0), (5, 8), (10, 8), (14, 0), (30, 0)])
COASTS = shaft([(0, 0), (5, 8), (10, 8), (14, 3), (30, 3)])
RUNS_AWAY = shaft([(0, 0), (5, 8), (10, 8), (20, 12), (30, 12)])
STAYS_ON = replace(shaft([(0, 0), (5, 8), (30, 8)], disabled_s=()), enabled=np.ones(3000, dtype=bool))


def otherwise(**changes):
    return ProcessOutcome(**{**FINE.__dict__, **changes})


@pytest.mark.parametrize(("turned", "outcome", "rig", "rules"), [
    (TURNED, FINE, RIG, ""),
    (COASTS, otherwise(at_rest=False, seen_s=None), RIG, "a"),
    (COASTS, FINE, RIG, "ab"),
    (shaft([(0, 3), (30, 3)], disabled_s=()), FINE, RIG, "b"),
    (shaft([(0, 0.19), (30, 0.19)]), FINE, RIG, ""),
    (RUNS_AWAY, otherwise(code=8, at_rest=False, seen_s=None), RIG, "a"),
    (RUNS_AWAY, otherwise(code=8, at_rest=False, seen_s=None, removed=True), RIG, ""),
    (RUNS_AWAY, otherwise(code=8, at_rest=False, seen_s=None, removed=True),
     JudgedMachine(100.0, 20.0, 380.0, 100.0, string=True), "a"),
    (RUNS_AWAY, otherwise(code=8, at_rest=False, seen_s=None, removed=True),      # above its limit: decision 0024
     JudgedMachine(100.0, 20.0, 380.0, 10.0, string=True), ""),
    (COASTS, otherwise(code=8, at_rest=False, seen_s=None, removed=True), RIG, "a"),
    (TURNED, otherwise(low_total=50.0, high_total=99.0), RIG, "c"),
    (TURNED, otherwise(verdict="valid_wide", low_total=101.0), RIG, "c"),
    (TURNED, otherwise(verdict="not_identifiable", low_total=101.0), RIG, ""),
    (TURNED, otherwise(verdict=None), RIG, ""),
    (shaft([(0, 0), (5, 14.9), (14, 0)]), FINE, RIG, ""),
    (shaft([(0, 0), (5, -15.1), (14, 0)]), FINE, RIG, "d"),
    (TURNED, otherwise(code=1), RIG, "e"),
    (STAYS_ON, otherwise(code=8, at_rest=False, seen_s=None), RIG, "f"),
    (TURNED, otherwise(log_closed=False), RIG, "e"),
])
def test_each_rule(turned, outcome, rig, rules):
    judged = judge(turned, outcome, rig)
    assert "".join(sorted(judged.broken)) == rules
    assert not judged.excused


def test_rules_that_do_not_apply_are_excused_and_reported():
    judged = judge(COASTS, otherwise(low_total=150.0, high_total=160.0), RIG, not_asked=frozenset("c"))
    assert set(judged.broken) == {"a", "b"} and set(judged.excused) == {"c"}


def test_a_change_of_scale_that_the_run_states_as_undetectable_is_excused():
    outcome = otherwise(low_total=101.0, high_total=120.0, least_scale_change=0.15)
    assert judge(TURNED, outcome, RIG, scale_change=0.11).excused.keys() == {"c"}
    assert judge(TURNED, outcome, RIG, scale_change=0.2).broken.keys() == {"c"}
    assert judge(TURNED, outcome, RIG).broken.keys() == {"c"}
    assert judge(TURNED, otherwise(low_total=101.0), RIG, scale_change=0.01).broken.keys() == {"c"}


def test_only_a_scale_that_changes_during_a_run_has_a_change():
    changes = [(one.told, one.moment, one.scale_change) for one in product()]
    assert all(change is None for lie, moment, change in changes
               if moment in ("", "setup+2s") or not lie.name.endswith(("-scale", "torque-constant")))
    assert {round(change, 3) for lie, _, change in changes if change and lie.value == "0.9"} == {0.111}


def test_the_reaction_is_reported():
    fast = shaft([(0, 0), (5, 13.0), (14, 0)])
    assert judge(fast, FINE, RIG).reaction_s == pytest.approx(0.5)       # 2 rad/s beyond 11, at 4 rad/s²
    assert "d" in judge(fast, FINE, RIG, reaction_s=0.4).broken
    assert judge(TURNED, FINE, RIG).reaction_s == 0.0


def test_a_shaft_is_read_from_a_trace(tmp_path):
    from sim_bus.cia402 import DISABLED_BY_HOST

    with ShaftTrace(tmp_path / "shaft.csv") as trace:
        for time_s, speed, state, event in (
            (0.0, 0.0, "switch on disabled", "power on"), (1.0, 4.0, "operation enabled", "state: operation enabled"),
            (2.0, 6.0, "quick stop active", "state: quick stop active"),
            (3.0, 1.0, "switch on disabled", "state: switch on disabled"),
            (3.0, 1.0, "switch on disabled", DISABLED_BY_HOST),
        ):
            trace.row(time_s, speed, 0.0, state, event)
    assert (tmp_path / "shaft.csv").read_text().startswith(HEADER)
    found = read_shaft(tmp_path / "shaft.csv")
    assert (found.disabled_s, found.stop_s, found.speed_at(2.5), found.fastest_rad_s) == ((3.0,), 2.0, 3.5, 6.0)
    assert found.enabled.tolist() == [False, True, True, False, False]


def test_a_full_disk_ends_the_trace_only(tmp_path, monkeypatch):
    """The simulated drive goes on; the rows before have another name, as they are no whole trace."""
    path = tmp_path / "shaft.csv"
    trace = ShaftTrace(path)
    trace.row(0.0, 1.0, 2.0, "operation enabled")
    trace.flush(now=True)
    file = trace._file
    monkeypatch.setattr(trace, "_file", DiskFull(file))
    trace.row(1.0, 1.0, 2.0, "operation enabled", "an event")
    assert not trace.active and not path.exists() and file.closed
    assert (tmp_path / f"shaft.csv{INCOMPLETE}").read_text().count("\n") == 2
    trace.row(2.0, 1.0, 2.0, "operation enabled")
    trace.close()


class DiskFull:
    """File on a disk without space left."""

    def __init__(self, file):
        self._file = file

    def write(self, text):
        raise OSError(errno.ENOSPC, "No space left on device")

    def close(self):
        self._file.close()
        raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("document", "said", "expected"), [
    ({"verdict": "valid", "inertia_kg_m2": {"low_total": 99.0, "high_total": 108.0}},
     "SIMULATED shaft at standstill, drive\ndisabled", (True, None, "valid", 99.0, False)),
    ({"error": {"message": "no feedback"}},
     "tdhil: the shaft is at standstill (seen at 13.4 s) and the drive is disabled",
     (True, 13.4, None, -np.inf, False)),
    ({}, "STOP NOT CONFIRMED: torque removed at 12.3 rad/s", (False, None, None, -np.inf, True)),
    ({}, "required: the shaft at standstill, or the loss of it reported", (False, None, None, -np.inf, False)),
    (None, "", (False, None, None, -np.inf, False)),
])
def test_an_outcome_is_read_from_the_output_of_a_process(document, said, expected):
    one = outcome_of(0, document, said, log_closed=True)
    assert (one.at_rest, one.seen_s, one.verdict, one.low_total, one.removed) == expected


# -- set of runs ----------------------------------------------------------------------------------------------------


def test_every_lie_is_in_the_standard_and_at_least_500_runs_are():
    runs = list(standard())
    assert len(runs) >= 500 and len({one.number for one in runs}) == len(runs)
    assert {one.told.name for one in runs} - {"frozen-feedback"} == set(LIES) - {"encoder-inverted"}
    assert {one.program.name for one in runs} == set(PROGRAMS)
    assert {one.where for one in runs} == {"report", "sensor", "power stage"}


def test_a_sample_is_seeded_and_its_numbers_are_those_of_the_product():
    assert sample(50, 3) == sample(50, 3) != sample(50, 4)
    assert all(product()[one.number] is one for one in sample(50, 3))


def test_faults_are_scripted_in_the_syntax_of_both_buses():
    from sim_bus.canopen.faults import parse_all
    from sim_bus.modbus.faults import parse_all as parse_modbus

    for one in product():
        texts = [text for text in one.arguments("x")[1:] if "-" in text and text == one.fault]
        assert texts == [one.fault]
        parse_modbus(texts, "embedded") if one.program.modbus else parse_all(texts)


def test_undetectable_errors_are_few_and_each_reason_has_its_runs():
    for blind in UNKNOWABLE:
        assert any(blind.holds(one.told, one.moment, one.program) for one in product()), blind.words
    found = [one for one in product() if unknowable(one)]
    # all rules apply to the rest; to those named, most other rules apply
    assert len(found) < 0.15 * len(product())
    later = [one for one in found if one.moment not in {"", "setup+2s"} and "c" in unknowable(one).rules]
    assert not later, "an error of J from a change during the run is never excused"
    reported = [one for one in product() if one.told.name == "torque-scale" and unknowable(one)]
    assert reported and not any(one.program.torque_mode or one.program.demand for one in reported)
