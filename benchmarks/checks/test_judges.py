"""A study fails where its requirement is not met: by the observed share, without a kind, or with too many refusals."""

from __future__ import annotations

import pytest

from benchmarks import frf_coverage, live_inertia, same_documents
from benchmarks.shares import met


@pytest.mark.parametrize(("count", "of", "limit", "good"), [
    (285, 300, {"least": 0.95}, True), (284, 300, {"least": 0.95}, False), (4, 200, {"most": 0.02}, True),
    (5, 200, {"most": 0.02}, False), (0, 0, {"most": 0.02}, False), (0, 0, {"least": 0.95}, False),
    (0, 3, {"most": 0.0}, True), (1, 3, {"most": 0.0}, False),
])
def test_the_observed_share_is_judged(count, of, limit, good):
    assert met("rows", count, of, **limit) is good


def tuned(kind, kept, refused=None):
    return {"kind": kind, "shaft": kind, "refused": refused, "kept": kept, "notch": False, "phase_deg": 45.0,
            "gain_db": 8.0, "share": 1.0}


def test_margins_are_judged_for_each_kind_with_its_refusals():
    pytest.importorskip("control", reason="python-control is not installed (pip install '.[test]')")
    from benchmarks.speed_loop_margins import kept

    good = [tuned(kind, True) for kind in ("rigid", "two-mass") for _ in range(20)]
    assert kept(good, 45.0, 8.0)
    assert not kept(good[:20], 45.0, 8.0)                                               # no shaft of two masses
    assert not kept([*good, *(tuned("rigid", False) for _ in range(2))], 45.0, 8.0)     # 20 of 22
    assert not kept([*good, *(tuned("rigid", None, "no gains") for _ in range(3))], 45.0, 8.0)


def verified(shaft, typed="agrees", wrong="differs", refused=None):
    return {"shaft": shaft, "refused": refused, "kind": "P", "typed": {"verdict": typed}, "wrong": {"verdict": wrong}}


def test_verification_is_judged_for_each_kind_with_its_refusals():
    pytest.importorskip("control", reason="python-control is not installed (pip install '.[test]')")
    from benchmarks.speed_loop_verify import told

    good = [verified(shaft) for shaft in ("rigid", "two-mass") for _ in range(20)]
    assert told(good) == 0
    assert told(good[:20]) == 1
    assert told([*good, *(verified("rigid", typed="cannot_tell") for _ in range(2))]) == 1
    assert told([*good, *(verified("two-mass", refused="no gains") for _ in range(3))]) == 1


def course(note="", intervals=3):
    from tdhil.recording import LiveInertia

    true = live_inertia.TRUE_KG_M2
    return live_inertia.Course(1, tuple(
        LiveInertia(0.0, number, 0.95, "valid", "", true, 0.9 * true, 1.1 * true) for number in range(intervals)), note)


def test_a_run_that_ended_or_has_no_interval_fails_the_live_study():
    assert live_inertia.covered([course()] * 3)
    assert not live_inertia.covered([course(), course(note="Stall()")])
    assert not live_inertia.covered([course(), course(intervals=0)])
    assert not live_inertia.covered([course(intervals=0)])
    assert not live_inertia.covered([])


def test_more_late_cycles_with_j_fail_only_beyond_chance():
    assert live_inertia.late_by_chance((30_000, 12), (30_000, 8))
    assert not live_inertia.late_by_chance((30_000, 30), (30_000, 8))
    assert live_inertia.late_by_chance((30_000, 0), (30_000, 40))
    assert not live_inertia.late_by_chance((0, 0), (30_000, 0))


def test_a_position_of_a_line_is_judged_beyond_chance_and_all_lines_by_their_share():
    assert frf_coverage.covered_enough("|ω/T|", [[True] * 93 + [False] * 7] * 2)
    assert not frf_coverage.covered_enough("|ω/T|", [[True] * 92 + [False] * 8] * 2)
    assert not frf_coverage.covered_enough("|ω/T|", [[True] * 200] * 4 + [[True] * 160 + [False] * 40])


def test_documents_differ_in_values_and_not_in_dates_or_versions():
    before = {"date": "1", "tdhil": "0.1.0", "inertia_kg_m2": {"low": 1.0, "high": 2.0},
              "rows": [{"a": 1}, {"a": 2}]}
    same = before | {"date": "2", "tdhil": "0.2.0"}
    assert list(same_documents.differing(before, same, {}, 0.0)) == []
    other = before | {"inertia_kg_m2": {"low": 1.0, "high": 2.5, "unit": "kg"}, "rows": [{"a": 1}]}
    assert list(same_documents.differing(before, other, {}, 0.0)) == [
        "inertia_kg_m2.high: 2.0, 2.5", "inertia_kg_m2.unit: absent, kg", "rows: 2 items, 1"]


def test_numbers_within_a_share_do_not_differ_and_the_share_is_kept():
    near: dict[str, float] = {}
    before, after = {"low": 1.0, "high": 2.0, "count": 3}, {"low": 1.0 + 1e-9, "high": 2.1, "count": 4}
    assert list(same_documents.differing(before, after, near, 1e-6)) == ["count: 3, 4", "high: 2.0, 2.1"]
    assert near == {"low": pytest.approx(1e-9)}
