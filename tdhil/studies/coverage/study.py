"""`tdhil study coverage`: does the interval cover the truth, on plants that the estimator knows nothing of?

Every plant of the fleet is simulated and identified many times over, each run with its own noise and its own rough
inertia. Counted are the intervals that miss; bias and scatter are held against the least that is possible.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, model_validator

from profiles.model import DataModel, Finding, refuse_if
from tdhil.studies.coverage.bound import cramer_rao
from tdhil.studies.coverage.plants import CoveragePlant
from tdhil.studies.study import Progress, Study, StudyOutcome
from tdhil.study.coverage_draw import draw_coverage
from tdhil.study.coverage_figures import PlantFigures, figures_of
from tdhil.study.coverage_fleet import FLEET
from tdhil.study.coverage_runs import Run, run_all, tasks
from tdhil.study.coverage_said import about_table, plant_table, refusal_table, said

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class CoverageSettings(DataModel):
    """How many runs, of which plants, how long, at what confidence."""

    seeds: Annotated[int, Field(ge=1, le=100_000)] = 500
    """Runs a plant."""
    plants: list[str] = Field(default_factory=list)
    """Names of plants; none for all of them."""
    periods: Annotated[int, Field(ge=4, le=200)] = 10
    """Periods that count, at each of two mean speeds."""
    confidence: Annotated[float, Field(ge=0.5, lt=1.0)] = 0.95
    processes: Annotated[int, Field(ge=1, le=64)] = 2
    seed: Annotated[int, Field(ge=0)] = 1

    @property
    def chosen(self) -> tuple[CoveragePlant, ...]:
        """The plants meant, in the fleet's order."""
        return tuple(plant for plant in FLEET if not self.plants or plant.name in self.plants)

    @model_validator(mode="after")
    def _known(self) -> CoverageSettings:
        names = [plant.name for plant in FLEET]
        findings: list[Finding] = [
            ("plants", f"no plant '{name[:40]}'; known: {', '.join(names)}")
            for name in self.plants
            if name not in names
        ]
        refuse_if(findings)
        return self


@dataclass
class CoverageStudy:
    """`tdhil study coverage`."""

    name: str = "coverage"
    title: str = "Coverage of the interval and closeness to the Cramér-Rao bound, plant by plant"

    @property
    def settings_model(self) -> type[CoverageSettings]:
        return CoverageSettings

    def run(self, settings: CoverageSettings, progress: Progress) -> StudyOutcome:
        """Every run of every plant; the same settings give the same bits, whatever the number of processes.

        Ctrl-C ends it with the figures of the runs that are done by then (``interrupted``); a second one, or one
        before the first runs are done, ends it without.
        """
        plants = settings.chosen
        wanted = tasks(plants, settings.seeds, settings.seed, settings.periods, settings.confidence)
        runs: dict[str, list[Run]] = {plant.name: [] for plant in plants}
        total, done = settings.seeds * len(plants), 0
        progress(0.0, "first runs")
        begun_s, interrupted = time.monotonic(), False
        try:
            for group in run_all(wanted, min(settings.processes, len(wanted))):
                runs[group[0].plant] += group
                done += len(group)
                left_s = (time.monotonic() - begun_s) * (total - done) / done
                of_plant = f"{group[0].plant}: {len(runs[group[0].plant])} of {settings.seeds} runs"
                progress(0.98 * done / total, f"{of_plant}; {done} of {total} in all, about {_told(left_s)} left")
        except KeyboardInterrupt:
            done = sum(map(len, runs.values()))     # it may have come between the two
            if done == 0:
                raise
            interrupted = True
        found = []
        some = [plant for plant in plants if runs[plant.name]]
        for index, plant in enumerate(some):
            progress(0.98 + 0.02 * index / len(some), f"{plant.name}: Cramér-Rao bound")
            found.append(figures_of(plant, runs[plant.name], cramer_rao(plant, settings.periods)))
        progress(1.0, "interrupted" if interrupted else "done")
        outcome = outcome_of(self, found, settings)
        return cut_short(outcome, done, total) if interrupted else outcome


def _told(duration_s: float) -> str:
    return f"{duration_s / 60.0:.0f} min" if duration_s >= 90.0 else f"{duration_s:.0f} s"


def cut_short(outcome: StudyOutcome, done: int, total: int) -> StudyOutcome:
    """The same, saying everywhere that it is not all that was asked for."""
    return replace(
        outcome,
        title=f"{outcome.title} (interrupted: {done} of {total} runs)",
        document={**outcome.document, "interrupted": {"runs": done, "of": total}},
        interrupted=True,
    )


def outcome_of(study: CoverageStudy, found: list[PlantFigures], settings: CoverageSettings) -> StudyOutcome:
    """Figures as tables, statements, document and picture."""
    nominal = 1.0 - settings.confidence

    def draw(figure: Figure) -> None:
        draw_coverage(figure, found, nominal)

    return StudyOutcome(
        name=study.name,
        title=study.title,
        tables=(plant_table(found, settings.confidence), about_table(found), refusal_table(found)),
        statements=said(found, settings.confidence),
        document={"plants": [_document(one) for one in found], "settings": settings.model_dump(mode="json")},
        simulated_s=sum(one.runs * one.run_seconds for one in found),
        draw=draw,
        figure_size_in=(8.0, 6.0),
    )


def _document(one: PlantFigures) -> dict[str, Any]:
    """All of a plant's figures, and the plant itself."""
    return {**asdict(one), "answered": one.answered, "rmse_over_bound": one.over_bound}


COVERAGE: Study = CoverageStudy()
