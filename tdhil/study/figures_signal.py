"""Figure 11: step and sine through the same loop (section 3.4.3).

The paper prints a gain of 0.96 for the sine (1 Hz, amplitude 1, offset 2π) and a "steady-state gain" of 1.16 for the
step from 2π to 2π + 1 at 0.25 s. No PI loop has a steady-state gain other than 1. Read as (largest speed − 2π)/1 the
second is the overshoot, that of the start from rest included, and then both fit one pair out of Table 1: P 15000 and
I 9000 give 0.96 and 1.17. These are the defaults of figures 9 to 13.
"""

from __future__ import annotations

from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import model_validator

from profiles.model import refuse_if
from tdhil.studies.paper.loop import LoopRecord, simulate
from tdhil.studies.paper.processing import response, torque_line
from tdhil.studies.paper.published import published
from tdhil.studies.study import Cell, Progress, ResultTable, Statement, StudyOutcome
from tdhil.study.settings import LoopSettings, Positive, SamplePeriod, changed

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class SignalSettings(LoopSettings):
    """The step goes from the offset to offset + amplitude at a quarter of the sine's period."""

    signal: Literal["sine"] = "sine"
    duration_s: Positive = 5.0
    sample_period_s: SamplePeriod = 0.0005

    @model_validator(mode="after")
    def _long_enough(self) -> SignalSettings:
        if 2 * self.period_steps > self.steps:
            refuse_if([("duration_s", "two periods of the sine at least are needed, one of them to settle")])
        return self

    @property
    def period_steps(self) -> int:
        """Samples in one period."""
        return round(1.0 / (self.frequency_hz * self.sample_period_s))


class SignalStudy:
    """Two runs side by side."""

    name = "figure11"
    title = "Figure 11: step and sine through the same loop"

    @property
    def settings_model(self) -> type[SignalSettings]:
        return SignalSettings

    def run(self, settings: SignalSettings, progress: Progress) -> StudyOutcome:
        runs = [changed(settings, signal="sine"), changed(settings, signal="step")]
        begun = perf_counter()
        record = simulate(runs, lambda share: progress(share, self.name))
        wall_s = perf_counter() - begun
        found = _measured(settings, record)
        rows: list[tuple[Cell, ...]] = list(found.items())
        progress(1.0, self.name)
        return StudyOutcome(
            name=self.name, title=self.title,
            tables=(ResultTable("figure11_gains", ("quantity", "value"), tuple(rows)),),
            statements=_statements(found), document={"settings": settings.model_dump(mode="json"), **found},
            simulated_s=record.simulated_s, simulation_wall_s=wall_s, draw=lambda figure: _draw(figure, record),
        )


def _measured(settings: SignalSettings, record: LoopRecord) -> dict[str, Any]:
    last_period = slice(settings.steps - settings.period_steps, settings.steps + 1)
    time, asked, speed, _ = record.of(0, last_period)
    sine = response(time, asked, speed, settings.frequency_hz)
    step_time, _, step, step_torque = record.of(1)
    _, _, sine_speed, sine_torque = record.of(0)
    before, size = settings.offset_rad_s, settings.amplitude_rad_s
    settling = step[len(step) * 9 // 10 :]
    return {
        "sine_gain": sine.gain,
        "sine_gain_fundamental": sine.gain_fundamental,
        "sine_phase_lag_deg": sine.lag_fundamental_deg,
        "step_peak_above_offset_over_step": float((step.max() - before) / size),
        "step_gain_at_the_end": float((settling.mean() - before) / size),
        "inertia_by_sine_kg_m2": torque_line(step_time, sine_speed, sine_torque).inertia_kg_m2,
        "inertia_by_step_kg_m2": torque_line(step_time, step, step_torque).inertia_kg_m2,
        "true_inertia_kg_m2": settings.inertia_kg_m2,
    }


def _statements(found: dict[str, float]) -> tuple[Statement, ...]:
    printed, truth = published().gains, found["true_inertia_kg_m2"]
    by_sine, by_step = found["inertia_by_sine_kg_m2"], found["inertia_by_step_kg_m2"]
    return (
        Statement(
            "the sine's gain is slightly below 1", f"{printed.sine:g}",
            f"{found['sine_gain']:.3f} over the last period, the fundamental "
            f"{found['sine_gain_fundamental']:.3f}; P and I are not "
            "printed, the defaults were chosen from Table 1 for this gain and the next",
            bool(np.isclose(found["sine_gain"], printed.sine, atol=0.01)),
        ),
        Statement(
            "the step's steady-state gain is above 1", f"{printed.step:g}",
            f"a PI loop's is 1 (here {found['step_gain_at_the_end']:.3f} over the last tenth). The largest speed lies "
            f"{found['step_peak_above_offset_over_step']:.2f} steps above the offset: an overshoot, part of it "
            "left from the start",
            None,
        ),
        Statement(
            "a sine suits identification better than a step", "section 3.4.3, in words",
            f"off by {by_sine - truth:+.1f} kg·m² with the sine, {by_step - truth:+.1f} with the step (all samples)",
            abs(by_sine - truth) < abs(by_step - truth),
        ),
    )


def _draw(figure: Figure, record: LoopRecord) -> None:
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, number, name in ((upper, 0, "sine"), (lower, 1, "step")):
        time, asked, speed, _ = record.of(number)
        axes.plot(time, asked, color="C3", lw=1.4, ls="--", label="input")
        axes.plot(time, speed, color="0.1", lw=1.3, label="output")
        axes.set_ylim(asked.min() - 1.2, max(asked.max(), speed.max()) + 0.5)      # the start lies below
        axes.set_ylabel(f"{name}: speed, rad/s")
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", fontsize=9)
    lower.set_xlabel("time, s")
    figure.tight_layout()
