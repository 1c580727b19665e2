"""Records of a shaft in stick-slip: no wrong interval, most are recognised, and there are no false alarms."""

from dataclasses import replace

import numpy as np
import pytest

from tdhil.estimation import Estimate, Options, ResidualTest, Verdict, identify
from tdhil.estimation.case import Case
from tdhil.estimation.conclude import conclude
from tdhil.estimation.result import Refused
from tdhil.estimation.samples import usable_samples
from tdhil.estimation.time_domain.fit import search
from tdhil.estimation.time_domain.identify import finding_of
from tdhil.estimation.time_domain.solve import Solved, local_test
from tdhil.estimation.time_domain.stick_slip import find_stick_slip
from tdhil.estimation.time_domain.windows import joined, measure, place_windows, runs, thinned
from tests.estimation.record_bench import FIELD, HEAVY, MOTIONS, SERVO, simulate
from tests.estimation.stick_slip_bench import every_shaft
from tests.estimation.stick_slip_bench import simulate as in_stick_slip

ANSWERED = (Verdict.VALID, Verdict.VALID_WIDE)


def named(recording):
    return find_stick_slip(
        usable_samples(recording), recording.speed_resolution_rad_s, recording.torque_resolution_nm)


def check(shafts):
    """Assert that no interval is wrong; return the number of recognised records."""
    count = 0
    for shaft, recording in zip(shafts, in_stick_slip(shafts), strict=True):
        found = identify(recording, Options())
        assert (found.verdict in ANSWERED) == (found.inertia is not None)
        if found.inertia is not None:
            assert found.inertia.low <= shaft.inertia_kg_m2 <= found.inertia.high, shaft
            assert found.residual.p_value >= 0.01
        elif "stick-slip" in found.reason:
            assert "turn faster" in found.advice
            count += 1
    return count


@pytest.mark.heavy
def test_stick_slip_is_recognised_without_a_wrong_interval():
    shafts = every_shaft()[::18]
    assert check(shafts) >= 0.6 * len(shafts)


@pytest.mark.parametrize("every", [
    pytest.param(18, marks=pytest.mark.heavy), pytest.param(1, marks=pytest.mark.long),
])
def test_none_of_108_records_in_stick_slip_has_a_wrong_interval(every):
    shafts = every_shaft()
    assert len(shafts) == 108
    some = shafts[1::every] if every > 1 else shafts
    assert check(some) >= 0.7 * len(some)


@pytest.mark.heavy
@pytest.mark.parametrize("machine", [FIELD, SERVO, HEAVY], ids=lambda machine: machine.name)
def test_good_records_are_never_reported_as_stick_slip(machine):
    """The records contain starts from standstill, coasting to standstill, and zero crossings of the speed."""
    for motion in (*MOTIONS, "foreign"):
        for recording in simulate(machine, motion, [1, 2]):
            assert named(recording) is None, motion


def solved(residual):
    number = Estimate(100.0, 99.0, 101.0)
    lag = Estimate(0.1, 0.05, 0.15)
    return Solved(number, number, None, lag, lag, lag, residual, (), False, False, 40)


def case():
    (recording,) = simulate(FIELD, "speed steps", [1])
    return Case(recording, Options(), samples=usable_samples(recording))


def test_a_result_without_a_residual_test_is_refused():
    with pytest.raises(Refused, match="too few frequencies to test the model"):
        finding_of(solved(None), case())


@pytest.mark.parametrize(("p_value", "stands"), [(0.0034, False), (0.0099, False), (0.011, True)])
def test_a_result_whose_residual_test_fails_at_one_percent_is_refused(p_value, stands):
    one = case()
    found = conclude(one, finding_of(solved(ResidualTest(3.0, 5.0, p_value)), one))
    assert (found.inertia is not None) == stands
    assert (found.verdict is Verdict.MODEL_REJECTED) == (not stands)


@pytest.mark.heavy
def test_a_record_with_few_frequencies_in_a_row_is_tested_as_well():
    """A machine that stops often has short windows. Larger groups of frequencies do not fit into them."""
    (recording,) = simulate(FIELD, "speed steps", [1])
    samples = thinned(usable_samples(recording))
    placed = place_windows(runs(samples, recording.speed_resolution_rad_s, 2.5))
    bins = joined([measure(window) for window in placed])
    found = search(bins, (), float(np.ptp(samples.torque_nm)))[-1]
    part = found.problem.bins
    short = replace(found.problem, bins=replace(part, window=np.arange(len(part)) // 5))
    test = local_test(short, found.fit.theta, 1.0)
    assert test is not None
    assert test.p_value > 0.001
