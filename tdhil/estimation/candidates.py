"""The table of candidates: which models are tried for J, in which order, from what data, and what J's interval
contains.

`walk` has the rule of selection. A route tries its rows in the order of the table. A row is tried if it applies to the
result so far, and its result replaces that one. A row that ends the walk is the last. Each route gives its rows their
two functions (`ModelTrial`); only the table knows the order.

The rule of the interval: J's interval contains every value of every candidate that the data do not contradict. For one
candidate, these are the values for every structure of the reporting filters, and those for one-pole filters.
``interval`` states what a row adds. docs/decisions/0045 gives the reasons.

`python docs/made_pages.py` makes docs/reference/candidates.md from the table. `benchmarks/mutate_candidates.py` leaves
out one row after another; the row's test must then fail.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Generic, Protocol, TypeVar


class FitRoute(StrEnum):
    """Routes through the table. ``LOAD`` runs within the row `LOAD_SWINGS` of ``LINES``, ``BAND`` within each row of
    ``RECORD``.
    """

    LINES = "periodic excitation: spectral lines"
    LOAD = "a load that oscillates, from the same lines"
    RECORD = "a record without periodic excitation"
    BAND = "friction in one band of such a record"


@dataclass(frozen=True)
class CandidateModel:
    """One row: ``model`` is fitted to ``data`` with the knowledge ``prior``.

    ``tried``: when the row applies. ``stands``: when its answer replaces the previous result. ``interval``: what this
    row adds to J's interval. ``reason``: why the row exists. ``test``: the test that fails without the row.
    """

    name: str
    route: FitRoute
    model: str
    data: str
    prior: str
    tried: str
    stands: str
    interval: str
    reason: str
    test: str


BEFORE_ECHO, CLEAR_LINES, WEAK_LINES, LOAD_SWINGS, BENT_FRICTION = (
    "before the echo", "clear lines", "weak lines", "load that oscillates", "bent friction")
KNOWN_PIPE, REQUESTED, TWO_MASSES, A_STRING, SCALED_PIPE, BY_DIFFERENCE = (
    "known pipe", "requested shaft", "two masses", "string", "scaled pipe", "lines by difference")
WIDE_BAND, NARROW_BAND = "wide band", "narrow band"
STRAIGHT, SQUARE = "straight friction", "friction of the speed squared"

_OF_LAGS = "stated lags; else lags of about 1 s at most, and a prior on what both reports share"
_OF_LINES = "B from the mean speeds"
_FAMILY = "profile over two poles, an average and a delay, joined with that of one pole each while it is the likelier"
_RECORD_FAMILY = "profile over two poles, an average and a delay, joined with that of one pole each"

CANDIDATES: tuple[CandidateModel, ...] = (
    CandidateModel(
        BEFORE_ECHO, FitRoute.LINES, model="inertia with the wave resistance of a pipe",
        data="all lines of the excitation", prior="the sizes of the pipe",
        tried="the excitation is prbs, and the requested model may be a string",
        stands="always; no further row is tried", interval="profile of its fit",
        reason="a bit on bottom changes the echo from period to period; before the echo J does not depend on the bit",
        test="tests/estimation/test_before_echo.py::test_the_inertia_is_covered",
    ),
    CandidateModel(
        CLEAR_LINES, FitRoute.LINES, model="rigid shaft; without lags for --model paper",
        data="lines with speed and torque clear of the scatter", prior=f"{_OF_LAGS}; {_OF_LINES}",
        tried="no compliant shaft is requested", stands="always, as the first", interval=_FAMILY,
        reason="the simplest model comes first",
        test="tests/estimation/test_nonlinear_friction.py::test_straight_friction_is_not_bent",
    ),
    CandidateModel(
        WEAK_LINES, FitRoute.LINES, model="rigid shaft", data="lines with speed or torque clear of the scatter",
        prior="as before", tried="a line that is weak in one signal contradicts the rigid shaft",
        stands="always; the load is then looked at, too", interval="as before",
        reason="at a resonance one of the two signals nearly vanishes, and that line has the most information",
        test="tests/estimation/test_two_mass.py::test_a_line_that_stands_still_at_the_antiresonance_is_no_weak_line",
    ),
    CandidateModel(
        LOAD_SWINGS, FitRoute.LINES, model="the rows of the load", data="the same lines without residual oscillation",
        prior="as before",
        tried="a compliant shaft is requested, or rig.yaml declares a string; with --model auto also if the residuals"
              " or a weak line contradict the rigid shaft; or if it is in doubt (no one-pole filters, p below 0.3, two"
              " masses explain much more)",
        stands="a shaft of these rows stands; with a declared string the rigid shaft stands only with one-pole filters"
               " and no string in sight",
        interval="see the rows of the load",
        reason="a resonance just above the band bends the lines as filters of two poles do; a string hangs where one is"
               " declared, whatever the residuals allow",
        test="tests/estimation/test_two_mass.py::test_auto_finds_two_masses_and_says_so",
    ),
    CandidateModel(
        BENT_FRICTION, FitRoute.LINES, model="rigid shaft with nonlinear friction (Stribeck effect, fan)",
        data="the lines of the rigid shaft, and the mean torques", prior="as before",
        tried="the rigid shaft is rejected; with --model auto also if p is below 0.01 and no load oscillates",
        stands="the residuals allow it, and −2 ln L falls by more than 2 ln n",
        interval="profiles of all friction curves that the data allow",
        reason="nonlinear friction changes the spectral lines; the residuals contradict the shaft, but not its J",
        test="tests/estimation/test_nonlinear_friction.py::test_a_bend_is_seen_behind_short_lags",
    ),
    CandidateModel(
        KNOWN_PIPE, FitRoute.LOAD, model="string", data="lines with speed or torque clear of the scatter",
        prior="inertia and stiffness of the pipe, with their tolerance", tried="rig.yaml gives the sizes of the pipe",
        stands="the residuals allow it, and the lines show its torsional oscillation; no further row is tried",
        interval=_FAMILY,
        reason="two equations more: four lines suffice for a string",
        test="tests/estimation/test_two_mass.py::test_what_is_known_of_a_pipe_counts_as_equations",
    ),
    CandidateModel(
        REQUESTED, FitRoute.LOAD, model="the requested shaft", data="the same lines", prior="none of the load",
        tried="--model two-mass or --model string", stands="the residuals allow it", interval=_FAMILY,
        reason="the user knows the shaft",
        test="tests/estimation/test_two_mass.py::test_a_model_that_is_asked_for_is_the_one_that_is_fitted",
    ),
    CandidateModel(
        TWO_MASSES, FitRoute.LOAD, model="two masses on a spring", data="the same lines", prior="none of the load",
        tried="no compliant shaft is requested",
        stands="the residuals allow it, and the lines show its torsional oscillation",
        interval=f"{_FAMILY}; joined with that of the string beside it",
        reason="the simplest shaft that oscillates; a third of a light string seems to turn with the motor, so that J"
               " holds the values of both",
        test="tests/estimation/test_two_mass.py::test_auto_finds_two_masses_and_says_so",
    ),
    CandidateModel(
        A_STRING, FitRoute.LOAD, model="string with a mass at its end", data="the same lines", prior="none of the load",
        tried="no compliant shaft is requested, and the lines give as many equations as a string has unknowns",
        stands="two masses are contradicted, or the string explains more than chance does (p of 0.001)",
        interval=_FAMILY, reason="a spring with mass",
        test="tests/estimation/test_string.py::test_auto_finds_the_string",
    ),
    CandidateModel(
        SCALED_PIPE, FitRoute.LOAD, model="string with the travel time of the pipe and a free impedance",
        data="the same lines", prior="the travel time of the pipe",
        tried="the data contradict the pipe, or as a test of a pipe that they allow: it then counts if it explains more"
              " than chance does (p of 0.001)",
        stands="never; at 0.75 to 1.33 times the impedance the pipe is left out with a warning, beyond that J does not"
               " stand",
        interval="none",
        reason="the scale of torque or speed is wrong if the travel time is that of the pipe and the impedance is not",
        test="tests/estimation/test_string.py::test_a_torque_scale_that_the_pipe_contradicts_leaves_no_inertia",
    ),
    CandidateModel(
        BY_DIFFERENCE, FitRoute.LOAD, model="the rows before, again",
        data="the same lines; a line on which the mean speeds differ counts by this difference", prior="as before",
        tried="no shaft is allowed, a line near the torsional resonance differs between the mean speeds, and half of"
              " the lines do not",
        stands="a shaft is allowed now", interval="as before",
        reason="dry friction of the load changes sign at the slower mean speed only",
        test="tests/estimation/test_two_mass.py::"
             "test_a_line_by_the_swing_that_the_mean_speeds_differ_at_counts_by_the_difference",
    ),
    CandidateModel(
        WIDE_BAND, FitRoute.RECORD, model="rigid shaft: the rows of the friction",
        data="frequencies up to 3 rad of the longer lag", prior=_OF_LAGS,
        tried="the record has frequencies beyond the narrow band", stands="J is bounded, and p is 0.01 or more",
        interval="the rows of the friction; joined with that of one-pole filters in the narrow band",
        reason="half of the information on the lags lies above 1.2 rad",
        test="tests/estimation/test_time_domain.py::test_what_stands_clear_beyond_the_lags_counts",
    ),
    CandidateModel(
        NARROW_BAND, FitRoute.RECORD, model="rigid shaft: the rows of the friction",
        data="frequencies up to 1.2 rad of the longer lag", prior=_OF_LAGS,
        tried="the wide band leaves J open, cannot be tested, or has p below 0.01", stands="always",
        interval="the rows of the friction",
        reason="there a filter of any structure is described by its mean and its spread",
        test="tests/estimation/test_time_domain.py::"
             "test_the_wide_band_is_left_where_the_model_is_doubtful_in_it_or_untested",
    ),
    CandidateModel(
        STRAIGHT, FitRoute.BAND, model="friction of T_c and B", data="the frequencies of the band", prior="as before",
        tried="always", stands="always, as the first", interval=_RECORD_FAMILY,
        reason="the simplest friction comes first",
        test="tests/estimation/test_time_domain.py::test_what_stands_clear_beyond_the_lags_counts",
    ),
    CandidateModel(
        SQUARE, FitRoute.BAND, model="friction of T_c, B and a part that grows with the speed squared",
        data="the frequencies of the band", prior="as before",
        tried="it lowers −2 ln L by more than the square of J's quantile",
        stands="it lowers −2 ln L by more than three times this square",
        interval=f"{_RECORD_FAMILY}; joined with that of straight friction where neither stands alone",
        reason="windage follows the shaft's own speed, and behind a lag it looks like inertia",
        test="tests/estimation/test_time_domain.py::test_windage_follows_the_shaft_s_own_speed_not_the_reported_one",
    ),
)


class WalkState(Protocol):
    """State of a walk so far; ``ended``: no further row is tried."""

    @property
    def ended(self) -> bool: ...


S = TypeVar("S", bound=WalkState)


@dataclass(frozen=True)
class ModelTrial(Generic[S]):
    """The two functions of a row: ``applies`` checks whether the row is tried, ``fit`` returns the state after its
    fit.
    """

    applies: Callable[[S], bool]
    fit: Callable[[S], S]


def rows(route: FitRoute) -> tuple[CandidateModel, ...]:
    """Return the rows of a route in their order."""
    return tuple(row for row in CANDIDATES if row.route is route)


def walk(route: FitRoute, trials: Mapping[str, ModelTrial[S]], standing: S) -> S:
    """Return the state after the rows of a route. Raises KeyError for a row without a trial."""
    for row in rows(route):
        trial = trials[row.name]
        if not standing.ended and trial.applies(standing):
            standing = trial.fit(standing)
    return standing
