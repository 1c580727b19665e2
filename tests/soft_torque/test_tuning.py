"""Gains from J with its interval: choice, refusals, and intervals that agree with draws of J."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from profiles import SpeedControllerParameters, load_profile
from tdhil.soft_torque import (
    NO_MARGINS,
    SOFTNESS_RANGE,
    ClosedSystem,
    Interval,
    Moved,
    Search,
    SpeedController,
    TopDrive,
    TuneCase,
    TuningRefused,
    drive_settings,
    figures_at,
    largest_stable_share,
    least_damping,
    loop_margins,
    lowest_turning,
    stability,
    string_modes_hz,
    tune,
    tuned_controller,
)
from tdhil.soft_torque.candidates import OUTER_SOFTNESSES, SOFTNESSES, gains, ranked_speeds
from tdhil.soft_torque.stability import StringResponses, response_of
from tests.soft_torque.cases import DRIVE, SOFT_025, STRING, string_with

pytestmark = pytest.mark.one_worker      # its fixture is expensive

HELD = string_modes_hz(STRING)
NARROW = Interval(1500.0, 1440.0, 1560.0)


def case(inertia=NARROW, lags=DRIVE.inner_lags_s, **asked):
    return TuneCase(STRING, TopDrive(inertia.value, 8.0, 60.0, lags), inertia, **asked)


@pytest.fixture(scope="module")
def tuned():
    return {one.kind: one for one in tune(case(), search=None).tuned}


def test_gains_that_no_search_can_judge_are_not_offered():
    """On a very light top drive, every grid point has an integral time of more than eight periods of the string."""
    found = {one.kind: one for one in tune(case(Interval(0.15, 0.145, 0.155)), search=None).tuned}
    for kind in ("soft", "compensated"):
        assert found[kind].controller is None
        assert "integral time" in found[kind].refusal and "eight periods of the string" in found[kind].refusal


@pytest.mark.heavy
def test_the_choice_ranks_best_of_all_gains_that_keep_the_margins(tuned):
    """Gains of a finer grid that keep every margin on every truth do not have a critical speed 5 % lower."""
    own = case()
    truths = own.truths()

    def speed(law):
        return float(np.exp(np.mean(np.log(ranked_speeds(truths[:6], [law])))))

    best = speed(tuned["soft"].controller)
    for softness in np.geomspace(0.1, 1.0, 7):
        for factor in (0.65, 0.75, 0.85, 0.95):
            law = gains(STRING, 1500.0, HELD[0], float(softness), factor)
            if speed(law) < 0.95 * best:
                margins = [loop_margins(truth.drive, law, truth.string) for truth in truths]
                assert any(own.required.failed(one) for one in margins)


def test_each_is_better_damped_than_the_stiff_one(tuned):
    assert 3.0 * tuned["stiff"].damping.value < min(tuned[kind].damping.value for kind in ("soft", "compensated"))


def test_gains_follow_the_recipe(tuned):
    soft, compensated = tuned["soft"].controller, tuned["compensated"]
    omega = 2.0 * np.pi * HELD[0] * tuned["soft"].frequency_factor
    assert soft.gain_nm_s_rad == pytest.approx(STRING.impedance_nm_s_rad / tuned["soft"].softness)
    assert soft.integral_nm_rad == pytest.approx(omega**2 * 1500.0)
    law = compensated.controller
    own = 2.0 * np.pi * HELD[0] * compensated.frequency_factor
    assert law.integral_nm_rad == pytest.approx(own**2 * (1500.0 - law.compensated_kg_m2))
    assert law.compensated_kg_m2 == pytest.approx(compensated.compensated_share * 1500.0)
    assert tuned["soft"].integral_nm_rad.low == pytest.approx(omega**2 * 1440.0)


def test_the_compensated_one_is_stable_over_the_whole_interval_and_keeps_a_reserve(tuned):
    one = tuned["compensated"]
    assert one.compensated_share <= 0.8 * one.largest_share + 1e-12
    for inertia in np.linspace(1440.0, 1560.0, 7):
        assert ClosedSystem(STRING, DRIVE.with_inertia(float(inertia)), one.controller).is_stable()


@pytest.mark.heavy
def test_the_reserve_is_kept_at_the_softness_that_is_chosen():
    """For a light rotor, the softest controller has the most damping and allows the least compensation."""
    light = TuneCase(STRING, TopDrive(104.126, 8.1, 60.0, DRIVE.inner_lags_s), Interval(104.126, 99.857, 108.242))
    one = next(found for found in tune(light, search=None).tuned if found.kind == "compensated")
    assert one.controller is not None
    assert one.compensated_share <= 0.8 * (largest_stable_share(light, one.softness, HELD) + 0.01)
    assert one.wrong[0].stable
    assert one.lag_reserve_s is None or one.lag_reserve_s > 0.01


def test_a_wider_interval_permits_less_compensation():
    shares = [largest_stable_share(case(Interval(1500.0, 1500.0 * (1 - e), 1500.0 * (1 + e))), 0.3, HELD)
              for e in (0.0, 0.1, 0.3)]
    assert shares[0] > shares[1] > shares[2]


@pytest.mark.heavy
@pytest.mark.parametrize("kind", ["stiff", "soft", "compensated"])
def test_intervals_agree_with_two_hundred_draws_of_j(tuned, kind):
    """The intervals contain 95 % of the draws, and are not wider than the range of the draws."""
    rng = np.random.default_rng(11)
    drawn = rng.normal(1500.0, 60.0 / 1.959964, 200)
    law = tuned[kind].controller
    seen = np.array([figures_at(case(), DRIVE.with_inertia(float(one)), law, HELD) for one in drawn])
    stated = (tuned[kind].reflection, tuned[kind].band_reflection, tuned[kind].damping)
    for column, interval in zip(seen.T, stated, strict=True):
        inside = np.mean((column >= interval.low - 1e-9) & (column <= interval.high + 1e-9))
        assert 0.91 <= inside <= 0.995
        assert interval.low >= column.min() - 1e-4
        assert interval.high <= column.max() + 1e-4


SPREAD = np.array([[0.004, 0.0], [-0.0032, 0.0024]])
"""Main axes of the uncertainty of two lags, speed filter and torque loop. Their sum, 33 ms, is more certain than
either."""


def measured_lags(along=(0.0, 0.0)):
    return (*(np.array([0.021, 0.012]) + np.asarray(along) @ SPREAD).tolist(),)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", [
    "soft", *(pytest.param(one, marks=pytest.mark.heavy) for one in ("present", "compensated")),
])
def test_intervals_with_measured_lags_and_gains_agree_with_two_hundred_draws(kind):
    """The intervals contain 95 % of the draws of J, of both correlated lags and of the present gains."""
    gain, integral = (1500.0, 1600.0, 1700.0), (900.0, 1000.0, 1100.0)

    def law(p=gain[1], i=integral[1]):
        return SpeedController(p, i)

    also = (
        *((Moved(inner_lags_s=measured_lags(-one)), Moved(inner_lags_s=measured_lags(one))) for one in np.eye(2)),
        (Moved(present=law(p=gain[0])), Moved(present=law(p=gain[2]))),
        (Moved(present=law(i=integral[0])), Moved(present=law(i=integral[2]))),
    )
    believed = case(lags=measured_lags(), present=law(), also=also, softness=0.2, compensated_share=0.4,
                    required=NO_MARGINS)
    one = {found.kind: found for found in tune(believed, search=None).tuned}[kind]
    rng, seen = np.random.default_rng(13), []
    for draw in rng.normal(size=(200, 5)) / 1.959964:
        drive = TopDrive(1500.0 + 60.0 * draw[0], 8.0, 60.0, measured_lags(draw[1:3]))
        drawn = law(gain[1] + 100.0 * draw[3], integral[1] + 100.0 * draw[4]) if kind == "present" else one.controller
        seen.append(figures_at(believed, drive, drawn, HELD))
    stated = (one.reflection, one.band_reflection, one.damping)
    for column, interval in zip(np.array(seen).T, stated, strict=True):
        inside = np.mean((column >= interval.low - 1e-9) & (column <= interval.high + 1e-9))
        assert 0.91 <= inside <= 0.995


def test_uncertain_lags_permit_less_compensation():
    longer = (Moved(inner_lags_s=(0.005,)), Moved(inner_lags_s=(0.08, 0.03)))
    assert largest_stable_share(case(also=(longer,)), 0.3, HELD) < largest_stable_share(case(), 0.3, HELD) - 0.05


def test_a_rising_mode_still_counts_as_the_lowest():
    """With a light rotor and compensation, the lowest mode rises towards the second one and still counts as lowest."""
    drive = TopDrive(104.0, 8.0, 60.0, DRIVE.inner_lags_s)
    law = tuned_controller(STRING, 104.0, 0.936, HELD[0], 0.26)
    light = TuneCase(STRING, drive, Interval(104.0, 100.0, 108.0))
    assert least_damping(light, drive, law, HELD) == pytest.approx(0.48, abs=0.02)


@pytest.mark.long
@pytest.mark.heavy
def test_the_cure_speed_over_the_interval_agrees_with_two_hundred_draws_of_j(tuned):
    """The cure speeds at the ends of J's interval enclose 95 % of the simulated draws, to the resolution of 1 rpm."""
    rng = np.random.default_rng(12)
    drawn = rng.normal(1500.0, 60.0 / 1.959964, 200)
    law = tuned["soft"].controller
    search = Search(lowest_rpm=54.0, highest_rpm=70.0, duration_s=80.0)
    ends = lowest_turning(STRING, [(DRIVE.with_inertia(one), law) for one in (1440.0, 1560.0)], "stuck", search)
    cures = lowest_turning(STRING, [(DRIVE.with_inertia(float(one)), law) for one in drawn], "stuck", search)
    low, high = min(ends) - 1.0, max(ends) + 1.0
    assert np.mean([low <= cure <= high for cure in cures]) >= 0.95


def test_softer_than_the_lags_allow_is_refused_with_its_numbers():
    words = r"a = 3 is beyond ζ/\(ω² J Στ\) = 0\.69.*Ask for less than 0\.62"
    with pytest.raises(TuningRefused, match=words) as caught:
        tune(case(lags=(0.40, 0.03), softness=3.0), search=None)
    assert caught.value.exit_code == 11


def light_with_long_lags(**asked):
    """A light drive with 153 ms of lag below 2,091 m of pipe: only a soft controller keeps the margins."""
    string = replace(string_with(length_m=2090.7, inertia_kg_m2=451.2), bottom_viscous_nm_s_rad=34.5)
    drive = TopDrive(43.102, 1.91266, 9.60842, (0.0259048, 0.12584, 0.00140209))
    return TuneCase(string, drive, Interval(43.102, 41.6232, 44.5807), present=SpeedController(250.112, 361.513),
                    **asked)


@pytest.mark.heavy
def test_a_light_drive_with_long_lags_gets_a_larger_softness():
    """No a up to 2 keeps the margins. The search goes on to the largest a that may be requested."""
    own = light_with_long_lags()
    found = {one.kind: one for one in tune(own, search=None).tuned}["soft"]
    assert found.controller is not None and 2.0 < found.softness <= SOFTNESS_RANGE[1]
    assert not found.failed
    for truth in own.truths():
        assert not own.required.failed(loop_margins(truth.drive, found.controller, truth.string, exact=True))


@pytest.mark.heavy
def test_a_very_heavy_drive_gets_a_smaller_softness():
    heavy = Interval(60_000.0, 58_000.0, 62_000.0)
    found = {one.kind: one for one in tune(case(heavy), search=None).tuned}["soft"]
    assert found.controller is not None and SOFTNESS_RANGE[0] <= found.softness < 0.05


@pytest.mark.heavy
def test_a_refused_softness_names_the_direction_that_helps():
    with pytest.raises(TuningRefused, match=r"a = 0\.5 leaves too little margin.*Ask for a larger a: [2-9]"):
        tune(light_with_long_lags(softness=0.5), search=None)
    with pytest.raises(TuningRefused, match=r"a = 5 leaves too little margin.*Ask for a smaller a: 0\.\d"):
        tune(case(softness=5.0), search=None)


def test_the_search_covers_what_may_be_requested():
    every = sorted((*SOFTNESSES, *OUTER_SOFTNESSES))
    assert (every[0], every[-1]) == SOFTNESS_RANGE
    assert max(high / low for low, high in pairwise(every)) < 1.8


@pytest.mark.heavy
def test_more_compensation_than_the_interval_allows_is_refused_with_its_numbers():
    wide = Interval(1500.0, 850.0, 2640.0)
    with pytest.raises(TuningRefused, match=r"50 % of J compensated is unstable if J is 850.*33 ms of lag"):
        tune(case(wide, compensated_share=0.5), search=None)
    tune(case(compensated_share=0.5, required=NO_MARGINS), search=None)      # accepted if the interval of J is narrow


def test_without_stable_soft_gains_it_is_refused_with_a_reason():
    found = {one.kind: one for one in tune(case(lags=(3.0, 2.0)), search=None).tuned}
    assert found["soft"].controller is None
    assert "lag" in found["soft"].refusal
    assert found["compensated"].controller is None


def test_broadband_is_refused_behind_these_lags(tuned):
    assert tuned["broadband"].controller is None
    assert "matching needs nearly all of J" in tuned["broadband"].refusal


@pytest.mark.heavy
def test_the_effect_of_a_wrong_j(tuned):
    """With an error of J of 12.6 % all are stable. With 76 %, the controller that compensates half of J is unstable."""
    small, large = tuned["soft"].wrong
    assert small.stable and large.stable
    half = {one.kind: one for one in tune(case(compensated_share=0.5, softness=0.25, required=NO_MARGINS), None).tuned}
    assert [one.stable for one in half["compensated"].wrong] == [True, False]


# ---------------------------------------------------------------------------------------------------------------------


def parameters(gain, integral):
    entry = {"source": "the manual, p. 1", "confidence": "likely"}
    return SpeedControllerParameters.model_validate(
        {"gain": {"title": "one P", "unit": gain, **entry}, "integral": {"title": "two I", "unit": integral, **entry}})


@pytest.mark.parametrize(("gain", "integral", "values"), [
    ("nm_s_rad", "ms", (1186.0, 1e3 * 1186.0 / 999.3)),
    ("nm_s_rad", "s", (1186.0, 1186.0 / 999.3)),
    ("nm_s_rad", "nm_rad", (1186.0, 999.3)),
    # 10 % of 1500 rpm is 15.708 rad/s. 1186 N·m·s/rad gives 18630 N·m for it, 186.3 % of 10 kN·m.
    ("percent_per_percent", "s", (18.63, 1186.0 / 999.3)),
    ("a_s_rad", "s", (None, 1186.0 / 999.3)),
    ("unknown", "unknown", (None, None)),
])
def test_gains_in_the_drives_own_units(gain, integral, values):
    found = drive_settings(parameters(gain, integral), SOFT_025, 10_000.0, 1500.0)
    assert [one.value for one in found] == [pytest.approx(value, rel=1e-3) if value else None for value in values]
    assert all(one.why for one in found if one.value is None)


def test_a_share_needs_the_name_plate():
    first, _ = drive_settings(parameters("percent_per_percent", "s"), SpeedController(10.0, 5.0))
    assert first.value is None
    assert "--rated-torque" in first.why
    assert drive_settings(None, SOFT_025) == ()


@pytest.mark.parametrize("name", [
    "siemens/s120-canopen", "siemens/g120", "abb/acs880-enhanced", "beckhoff/ax8000", "kollmorgen/akd", "maxon/epos4",
    "danfoss/fc302", "yaskawa/ga700", "elmo/gold"])
def test_profiles_with_a_speed_controller_need_no_question_before_a_run(name):
    profile = load_profile(name)
    assert profile.speed_controller is not None
    assert not any("speed_controller" in entry for entry, _ in profile.entries())


def test_the_frequency_response_of_a_string_is_computed_once_for_all_shares(monkeypatch):
    """Each share has its own gains, but the string is the same. A response that covers their crossings is kept."""
    made = []

    def counted(string, highest_rad_s):
        made.append(string)
        return response_of(string, highest_rad_s)

    monkeypatch.setattr(stability, "response_of", counted)
    longer = (Moved(inner_lags_s=(0.005,)), Moved(inner_lags_s=(0.08, 0.03)))
    responses = StringResponses()
    first = largest_stable_share(case(also=(longer,)), 0.3, HELD, responses=responses)
    count = len(made)
    assert set(made) == {STRING} and count <= 3
    assert largest_stable_share(case(also=(longer,)), 0.3, HELD, responses=responses) == first
    assert len(made) == count
