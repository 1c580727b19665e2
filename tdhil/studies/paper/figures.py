"""Figures 16 and 17: range analysis as main-effect plots, ours and the published level means."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tdhil.studies.paper.design_runs import DesignResult, run_design
from tdhil.studies.paper.orthogonal_design import DesignSettings
from tdhil.studies.paper.published import PublishedDesign
from tdhil.studies.paper.table_statements import ranks_statement
from tdhil.studies.paper.tables import effect_document, effect_table, published_for
from tdhil.studies.study import Progress, StudyOutcome
from tdhil.study.settings import LABELS

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class EffectStudy:
    """`figure16` (Table 6) and `figure17` (Table 7)."""

    def __init__(self, name: str, title: str, model: type[DesignSettings], table: str) -> None:
        self.name = name
        self.title = title
        self._model = model
        self._table = table

    @property
    def settings_model(self) -> type[DesignSettings]:
        return self._model

    def run(self, settings: DesignSettings, progress: Progress) -> StudyOutcome:
        result = run_design(settings, lambda share: progress(share, f"{self.name}: {len(settings.rows)} runs"))
        paper = published_for(self._table, settings)
        factors = effect_document(settings, result)
        progress(1.0, self.name)
        return StudyOutcome(
            name=self.name, title=self.title, tables=(effect_table(self.name, settings, result, paper),),
            statements=(ranks_statement(result, paper),) if paper else (),
            document={"settings": settings.model_dump(mode="json"), "factors": factors},
            simulated_s=result.simulated_s, simulation_wall_s=result.wall_s,
            draw=lambda figure: draw_effects(figure, settings, result, paper),
        )


def draw_effects(figure: Figure, settings: DesignSettings, result: DesignResult, paper: PublishedDesign | None) -> None:
    """Level means side by side, one panel per factor on a common axis, as the paper draws them."""
    panels = figure.subplots(1, len(settings.factors), sharey=True, squeeze=False)[0]
    for index, (axes, factor, effect) in enumerate(zip(panels, settings.factors, result.effects, strict=True)):
        at = range(1, len(effect.means) + 1)
        axes.plot(at, effect.means, "o-", color="C0", ms=5, label="here")
        name = LABELS[factor.field]
        if paper:
            printed = paper.factors[index]
            axes.plot(at, printed.mean_inertia_kg_m2, "s--", color="0.2", mfc="none", ms=6, label="published")
            name = f"{printed.letter}: {name}"
        axes.set_xticks(list(at), [_short(level) for level in factor.levels], rotation=45)
        axes.set_xlabel(name, fontsize=9)
        axes.set_title(f"R = {effect.range:.2f}", fontsize=9)
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8)
        axes.margins(x=0.15)
    panels[0].set_ylabel("mean identified " + LABELS["inertia_kg_m2"])
    panels[0].legend(fontsize=8)
    figure.tight_layout(w_pad=0.4)


def _short(level: float) -> str:
    """For a tick: two decimals at most, unless it is a small one."""
    return f"{round(level, 2):g}" if abs(level) >= 0.1 else f"{level:g}"
