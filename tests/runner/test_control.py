"""PI control of the mean speed by the host: gains, limit, and convergence with a reporting lag."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdhil.runner.excitation import RigGuess
from tdhil.runner.settings import ControlAssumptions
from tdhil.runner.stages.hold import MeanSpeedControl

MODEL = RigGuess(inertia_kg_m2=100.0, viscous_nm_s_rad=8.0, coulomb_nm=60.0)
DT_S = 0.004


def control(authority_nm=100.0, **assumptions):
    return MeanSpeedControl(MODEL, authority_nm, ControlAssumptions(**assumptions))


def test_the_first_answer_is_kp_e_and_one_step_of_ki_e():
    # ω_b = 0.2/0.5 = 0.4, K_p = 100·0.4 = 40, K_i = 40·0.4/4 = 4
    assert control().update(0.5, DT_S) == pytest.approx(40.0 * 0.5 + 4.0 * 0.5 * DT_S)


def test_a_longer_lag_makes_it_slower():
    assert control(largest_speed_lag_s=2.0).update(0.5, DT_S) == pytest.approx(10.0 * 0.5 + 0.25 * 0.5 * DT_S)


def test_the_integral_grows_while_the_error_stays():
    pi = control()
    for _ in range(250):
        torque = pi.update(0.5, DT_S)
    assert torque == pytest.approx(20.0 + 4.0 * 0.5 * 1.0)


@given(st.lists(st.floats(-50.0, 50.0), min_size=1, max_size=200), st.floats(0.1, 500.0))
def test_it_never_adds_more_than_its_authority(errors, authority_nm):
    pi = control(authority_nm)
    for error in errors:
        assert abs(pi.update(error, 0.1)) <= authority_nm


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_it_does_not_wind_up_at_the_bound(sign):
    pi = control(30.0)
    for _ in range(100_000):
        assert pi.update(sign * 5.0, DT_S) == sign * 30.0
    assert sign * pi.update(-sign * 0.5, DT_S) < 0.0       # reverses at once


@pytest.mark.parametrize("lag_s", [0.0, 0.1, 0.4, 0.5, 2.0])
@pytest.mark.parametrize("inertia_share", [0.8, 1.0, 1.25])
def test_it_settles_behind_a_lag_up_to_four_times_the_assumed_one(lag_s, inertia_share):
    """Plant and lag by small Euler steps, with 3 N·m of unknown friction to compensate."""
    pi = control()
    speed, reported = 4.0, 4.0
    history = []
    for _ in range(int(120.0 / DT_S)):
        torque = MODEL.steady_torque_nm(5.0) + pi.update(5.0 - reported, DT_S)
        net = torque - MODEL.coulomb_nm - 3.0 - MODEL.viscous_nm_s_rad * speed
        speed += DT_S * net / (inertia_share * MODEL.inertia_kg_m2)
        reported += (speed - reported) * (DT_S / (lag_s + DT_S))
        history.append(speed)
    assert max(history) < 5.0 + 0.6
    assert history[-1] == pytest.approx(5.0, abs=0.02)
