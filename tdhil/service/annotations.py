"""Annotations of a run, edited after it: tags, archived, and the texts of `STATED`. Pure data, annotations.json.

The log and the request stay as they were recorded. An edit stands beside them, with user, time, old and new value.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from tdhil.config import OPTION, STATED

MOST_TAGS: Final = 20
"""Largest number of tags of a run."""
LONGEST_TAG: Final = 40
"""Longest tag, characters."""
LONGEST_TEXT: Final[Mapping[str, int]] = {name: OPTION[name].longest or 0 for name in STATED}
"""Longest text of each kind, characters: as in the request of a run."""


@dataclass(frozen=True)
class AnnotationEdit:
    """One edit of an annotation: when, by which user, and the values before and after it."""

    at: str
    who: str
    field: str
    old: str
    new: str


@dataclass(frozen=True)
class Annotations:
    """Present annotations of a run. None for a text: as recorded."""

    tags: tuple[str, ...] = ()
    operator: str | None = None
    note: str | None = None
    customer: str | None = None
    order_number: str | None = None
    place: str | None = None
    archived: bool = False
    edits: tuple[AnnotationEdit, ...] = ()

    @staticmethod
    def of_plain(plain: Mapping[str, Any]) -> Annotations:
        """Read annotations. Raises TypeError for other data."""
        known = dict(plain)
        edits = tuple(AnnotationEdit(**one) for one in known.pop("edits", ()))
        return Annotations(tuple(map(str, known.pop("tags", ()))), edits=edits, **known)

    def plain(self) -> dict[str, Any]:
        """Return the annotations as plain data for JSON."""
        return asdict(self)

    def text(self, field: str, recorded: Mapping[str, Any]) -> str:
        """Return a present text, such as the operator: the edited one, else the one in the request's options."""
        edited: str | None = getattr(self, field)
        return str(recorded.get(field) or "") if edited is None else edited

    @property
    def text_edits(self) -> list[AnnotationEdit]:
        """Return the edits of texts, which a report shows."""
        return [one for one in self.edits if one.field in LONGEST_TEXT]

    def shown_on(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Return a result with the present texts and their edits, for its report."""
        present = {name: one for name in LONGEST_TEXT if (one := getattr(self, name)) is not None}
        return {**document, **present, "edits": [asdict(one) for one in self.text_edits]}

    def edited(
        self, recorded: Mapping[str, Any], who: str, at: str, *, tags: Iterable[str] | None = None,
        archived: bool | None = None, **texts: str | None,
    ) -> Annotations:
        """Return the annotations after an edit; None leaves a value. An equal value is no edit."""
        found = self
        new_tags = None if tags is None else tuple(tags)
        for field, old, new, value in (
            ("tags", ", ".join(self.tags), None if new_tags is None else ", ".join(new_tags), new_tags),
            *((name, self.text(name, recorded), new, new) for name, new in texts.items()),
            ("archived", _yes(self.archived), None if archived is None else _yes(archived), archived),
        ):
            if new is not None and new != old:
                changed: dict[str, Any] = {field: value, "edits": (*found.edits,
                                                                   AnnotationEdit(at, who, field, old, new))}
                found = replace(found, **changed)
        return found


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def one_line(text: str) -> str:
    """Return the text in Unicode's composed form, on one line, with single spaces."""
    shown = unicodedata.normalize("NFC", text)
    return " ".join("".join(sign if sign.isprintable() else " " for sign in shown).split())


def tags_of(given: Iterable[str]) -> tuple[str, ...]:
    """Return the tags, each once in upper or lower case, in the given order. Raises ValueError in words."""
    found: dict[str, str] = {}
    for one in given:
        tag = one_line(one)
        if not tag:
            continue
        if "," in tag:
            raise ValueError(f"a tag has no comma: {tag[:LONGEST_TAG]!r}")
        if len(tag) > LONGEST_TAG:
            raise ValueError(f"a tag has at most {LONGEST_TAG} characters, not {len(tag)}")
        found.setdefault(tag.casefold(), tag)
    if len(found) > MOST_TAGS:
        raise ValueError(f"a run has at most {MOST_TAGS} tags, not {len(found)}")
    return tuple(found.values())
