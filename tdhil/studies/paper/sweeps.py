"""Figures 9, 10, 12 and 13: response of the speed to a sine, over one swept parameter (section 3.4).

P and I of these figures are not printed, but "the parameters are held constant" in 3.4.1 to 3.4.3: the defaults are
therefore those that give the two gains printed for figure 11 (`figures.SignalSettings`). Amplitude, gain and phase are
those of the last whole periods of each record's second half.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, ValidationError, model_validator

from profiles import Positive, refuse_if
from tdhil.recording import FloatArray
from tdhil.studies.paper.loop import LABELS, LoopSettings, SamplePeriod, changed, simulate
from tdhil.studies.paper.processing import Response, response, settled_periods
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, StudyOutcome

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# ---------------------------------------------------------------------------------------------------------------------
# Plot of a sweep, as in figures 9, 10, 12 and 13: waveforms, amplitude difference, gain and phase.


_SHOWN_PERIODS = 2.0


@dataclass(frozen=True)
class Curve:
    """Settled part of one run; time in periods, so that frequencies share an axis."""

    value: float
    periods: FloatArray
    asked_rad_s: FloatArray
    speed_rad_s: FloatArray


def draw_sweep(figure: Figure, swept: str, curves: Sequence[Curve], responses: Sequence[Response]) -> None:
    """Draw the waveforms on the left, the input in red as in the paper; on the right the measured values."""
    grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1.0))
    waves = figure.add_subplot(grid[:, 0])
    shades = ("0.1", "C0", "C2", "C1", "C4", "C5", "C6", "C8", "C9")    # the usual ones without red, the input's
    for index, curve in enumerate(curves):
        shown = curve.periods <= _SHOWN_PERIODS
        waves.plot(curve.periods[shown], curve.speed_rad_s[shown], color=shades[index % len(shades)], lw=1.2,
                   label=f"{curve.value:g}")
    shown = curves[0].periods <= _SHOWN_PERIODS
    waves.plot(curves[0].periods[shown], curves[0].asked_rad_s[shown], color="C3", lw=1.6, ls="--", label="input")
    low, high = waves.get_ylim()
    waves.set_ylim(low, high + 0.32 * (high - low))      # space for the legend
    waves.set(xlabel="time, periods", ylabel="speed, rad/s")
    waves.legend(title=LABELS[swept], fontsize=9, title_fontsize=9, ncols=2, loc="upper right")
    waves.grid(alpha=0.3)
    values = [curve.value for curve in curves]
    panels = (
        ("A$_{in}$ − A$_{out}$, rad/s", [one.amplitude_difference_rad_s for one in responses], None),
        ("gain A$_{out}$/A$_{in}$", [one.gain for one in responses], None),
        ("phase lag, °", [one.lag_fundamental_deg for one in responses], [one.lag_zeros_deg for one in responses]),
    )
    first: Axes | None = None
    for row, (label, main, second) in enumerate(panels):
        axes = figure.add_subplot(grid[row, 1], sharex=first)
        first = first or axes
        axes.plot(values, main, "o-", color="0.15", ms=5, lw=1.1, label="fundamental")
        if second is not None:
            axes.plot(values, second, "x", color="C3", ms=7, label="zero crossing")
            axes.legend(fontsize=8)
        axes.set_ylabel(label, fontsize=9)
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8, labelbottom=row == len(panels) - 1)
        if swept == "frequency_hz":
            axes.set_xscale("log")
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()
    axes.set_xlabel(LABELS[swept])
    figure.tight_layout()


# ---------------------------------------------------------------------------------------------------------------------

Values = Annotated[tuple[Positive, ...], Field(min_length=2, max_length=24)]


class SweepSettings(LoopSettings):
    """Settings of a sweep: one field takes ``values``, all others are common.

    ``duration_s`` and ``sample_period_s`` are those of a run at ``frequency_hz``: a run at another frequency gets the
    same number of periods (the paper: ten) and of samples.
    """

    swept: ClassVar[str]
    signal: Literal["sine"] = "sine"
    sample_period_s: SamplePeriod = 0.0005
    values: Values

    @property
    def varied(self) -> frozenset[str]:
        """Fields that vary. A swept frequency is not among them, because it still scales duration and sampling."""
        return frozenset({self.swept} - {"frequency_hz"})

    def runs(self) -> list[LoopSettings]:
        """Return one run for each value."""
        runs = []
        for value in self.values:
            longer = self.frequency_hz / value if self.swept == "frequency_hz" else 1.0
            times = {"duration_s": self.duration_s * longer, "sample_period_s": self.sample_period_s * longer}
            runs.append(changed(self, **times, **{self.swept: value}))
        return runs

    @model_validator(mode="after")
    def _all_simulable(self) -> SweepSettings:
        try:
            runs = self.runs()
        except ValidationError as error:
            item = error.errors(include_url=False)[0]
            refuse_if([("values", f"one run can't be simulated: {item['msg'].removeprefix('Value error, ')}")])
            raise
        if settled_periods(runs[0].steps, runs[0].sample_period_s, 1.0 / runs[0].frequency_hz) is None:
            refuse_if([("duration_s", "the second half must hold one whole period at least")])
        return self


class InertiaSweep(SweepSettings):
    """Settings of figure 9; J0 = 900 kg·m², and 0.5, 2 and 3 times as much."""

    swept: ClassVar[str] = "inertia_kg_m2"
    values: Values = (450.0, 900.0, 1800.0, 2700.0)


class FrequencySweep(SweepSettings):
    """Settings of figure 10."""

    swept: ClassVar[str] = "frequency_hz"
    values: Values = (0.1, 0.2, 0.5, 1.0, 2.0)


class KpSweepSettings(SweepSettings):
    """Settings of figure 12; P of Table 1."""

    swept: ClassVar[str] = "kp_nm_s_rad"
    values: Values = (5000.0, 10000.0, 15000.0)


class KiSweepSettings(SweepSettings):
    """Settings of figure 13; I of Table 1."""

    swept: ClassVar[str] = "ki_nm_rad"
    values: Values = (1500.0, 3000.0, 6000.0, 9000.0)


@dataclass(frozen=True)
class SweepPoint:
    """One value of the swept parameter, and the response of the speed."""

    value: float
    response: Response


Claims = Callable[[SweepSettings, list[SweepPoint]], tuple[Statement, ...]]


class SweepStudy:
    """Study of one of figures 9, 10, 12, 13."""

    def __init__(self, name: str, title: str, model: type[SweepSettings], claims: Claims) -> None:
        self.name = name
        self.title = title
        self.settings_model = model
        self._claims = claims

    def run(self, settings: SweepSettings, progress: Progress) -> StudyOutcome:
        runs = settings.runs()
        begun = perf_counter()
        record = simulate(runs, lambda share: progress(share, f"{self.name}: {len(runs)} runs"))
        wall_s = perf_counter() - begun
        points, curves = [], []
        for number, run in enumerate(runs):
            window = settled_periods(run.steps, run.sample_period_s, 1.0 / run.frequency_hz)
            assert window is not None   # the settings were checked for this
            time, asked, speed, _ = record.of(number, window)
            points.append(SweepPoint(settings.values[number], response(time, asked, speed, run.frequency_hz)))
            curves.append(Curve(settings.values[number], (time - time[0]) * run.frequency_hz, asked, speed))
        progress(1.0, self.name)
        return StudyOutcome(
            name=self.name, title=self.title, tables=(_table(self.name, settings, points),),
            statements=self._claims(settings, points), document=_document(settings, points),
            simulated_s=record.simulated_s, simulation_wall_s=wall_s,
            draw=lambda figure: draw_sweep(figure, settings.swept, curves, [point.response for point in points]),
        )


def _columns(point: SweepPoint) -> dict[str, float]:
    found = point.response
    return {
        "amplitude_in_rad_s": found.amplitude_in_rad_s, "amplitude_out_rad_s": found.amplitude_out_rad_s,
        "amplitude_difference_rad_s": found.amplitude_difference_rad_s, "gain": found.gain,
        "phase_lag_zero_crossing_deg": found.lag_zeros_deg, "gain_fundamental": found.gain_fundamental,
        "phase_lag_fundamental_deg": found.lag_fundamental_deg,
    }


def _table(name: str, settings: SweepSettings, points: list[SweepPoint]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = [(point.value, *_columns(point).values()) for point in points]
    return ResultTable(f"{name}_response", (settings.swept, *_columns(points[0])), tuple(rows))


def _document(settings: SweepSettings, points: list[SweepPoint]) -> dict[str, Any]:
    runs = [{settings.swept: point.value, **_columns(point)} for point in points]
    return {"settings": settings.model_dump(mode="json"), "runs": runs}
