"""Settings of a study from a file and from `--set`: the defaults, then the file, then each assignment.

::

    study: table7               # a study's name
    settings:                   # any of its settings; what is left out keeps its default
      kp_nm_s_rad: 3000
      array: [[1, 1], [1, 2], [2, 1], [2, 2]]
      factors:
        - {name: J, levels: [450, 900]}
        - {name: viscous_nm_s_rad, levels: [10, 100]}
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError, create_model

from profiles import DataFileError, DataModel, Problem, load_model, load_with_lines, messages_of, read_tree
from tdhil.errors import MessageCode, UsageError
from tdhil.studies.paper import SYMBOLS, full_name
from tdhil.studies.study import Study

M = TypeVar("M", bound=BaseModel)


class _Envelope(DataModel):
    study: str
    settings: dict[str, Any] = Field(default_factory=dict)


def load_study_file(path: Path, studies: Mapping[str, Study]) -> tuple[Study, Any]:
    """Return the study named in a file, and its settings. Raises DataFileError with each problem and its line."""
    envelope = load_with_lines(path, _Envelope)
    name = envelope.value.study
    if name not in studies:
        line = envelope.lines.get(("study",), 0)
        raise DataFileError((Problem(str(path), line, f"study: no study '{name[:40]}'; known: {', '.join(studies)}"),),
                            entry=MessageCode.STUDY_SETTING_WRONG)
    model = studies[name].settings_model
    if not envelope.value.settings:
        return studies[name], model()
    whole = create_model(f"{name}_file", __base__=DataModel, study=(str, ...), settings=(model, ...))
    return studies[name], getattr(load_model(path, whole), "settings")  # noqa: B009 - a field made just now


def with_assignments(settings: M, assignments: Iterable[str]) -> M:
    """Return ``settings`` with every ``name=value`` applied, all checked together. Raises UsageError in one line.

    A name is a field, its symbol (`Kp`), or a field of a section (`rig.inertia_kg_m2`); a value has the form of YAML
    (`3000`, `[0.1, 0.5]`).
    """
    data = settings.model_dump(mode="json")
    for assignment in assignments:
        name, sign, text = (part.strip() for part in assignment.partition("="))
        if not (name and sign and text):
            raise UsageError(f"--set {assignment}: must be name=value", next_step="For example --set Kp=3000",
                             entry=MessageCode.STUDY_SETTING_WRONG)
        *sections, last = name.split(".")
        fields = type(settings).model_fields      # the model refuses an unknown name
        named = (one for one in (name, full_name(name), name.lower()) if one in fields)
        field = last if sections else next(named, name)
        if not sections and field in getattr(settings, "varied", ()):     # the value would have no effect
            raise UsageError(
                f"--set {assignment}: {field} is what this study varies from run to run",
                next_step="Change its levels: 'factors' of a design, 'values' of a sweep",
                entry=MessageCode.STUDY_SETTING_WRONG,
            )
        tree = read_tree(f"value: {text}", "--set")
        if tree.problems or not isinstance(tree.data, dict) or list(tree.data) != ["value"]:
            why = tree.problems[0].message if tree.problems else "must be one value"
            raise UsageError(f"--set {assignment}: {why}", entry=MessageCode.STUDY_SETTING_WRONG)
        place: Any = data
        for section in sections:
            place = place.get(section) if isinstance(place, dict) else None
        if not isinstance(place, dict):
            raise UsageError(f"--set {assignment}: there is no section '{'.'.join(sections)}'",
                             entry=MessageCode.STUDY_SETTING_WRONG)
        place[field] = tree.data["value"]
    try:
        return type(settings).model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        problems = [
            f"{'.'.join(str(part) for part in path)}: {message}" if path else message
            for path, message in messages_of(error, data, type(settings))
        ]
        raise UsageError("--set " + "; ".join(problems), next_step=f"Symbols: {', '.join(SYMBOLS)}",
                         entry=MessageCode.STUDY_SETTING_WRONG) from None
