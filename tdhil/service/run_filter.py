"""Which runs a list shows, and in which order. The index and the rows of live runs follow the same rules."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from tdhil.config import STATED


@dataclass(frozen=True)
class Summary:
    """A row of the list of runs."""

    id: str
    rig: str
    state: str
    asked: str
    asked_by: str
    ended: str | None = None
    simulated: bool = True
    verdict: str | None = None
    inertia_kg_m2: float | None = None
    low_kg_m2: float | None = None         # coverage interval to quote, with the torque scale's uncertainty
    high_kg_m2: float | None = None
    repeatability_rel: float | None = None
    exit_code: int | None = None
    rehearsal: bool = False                # whether a fault of the simulated drive was rehearsed
    uploaded: bool = False                 # whether the recording was uploaded: no history of a rig
    operator: str | None = None            # as edited later, else as recorded; `note` too
    note: str | None = None
    tags: tuple[str, ...] = ()
    archived: bool = False
    customer: str | None = None
    order_number: str | None = None
    place: str | None = None
    acceptance: str | None = None          # verdict on the expected values; None without any

    def contains(self, text: str) -> bool:
        """Return whether every word of ``text`` occurs in a text of this row, in upper or lower case."""
        said = self.searched
        return all(word in said for word in text.casefold().split())

    @property
    def searched(self) -> str:
        """Return the text in which a search looks, in lower case."""
        kept = {**self.__dict__, "tags": ", ".join(self.tags)}
        return " ".join(str(kept[name] or "") for name in SEARCHED).casefold()


SEARCHED: Final = ("id", "rig", "state", "asked", "asked_by", "verdict", "acceptance", *STATED, "tags")
"""Columns of `Summary` in which a search finds text."""


T = TypeVar("T", bound=Summary)
SEARCHED_COLUMN: Final = "searched"
"""Column of the index with the text of a row in lower case, so that a search calls no function for each row."""
SORTS: Final = {
    "id": ("id",), "rig": ("rig",), "state": ("state",), "inertia_kg_m2": ("inertia_kg_m2",), "verdict": ("verdict",),
    "acceptance": ("acceptance",), "note": ("operator", "note"),
}
"""Keys by which a list can be sorted, with their columns."""


@dataclass(frozen=True)
class RunFilter:
    """Conditions on the runs of a list. None: any. ``archived``: archived runs, too. ``answered``: only with J.

    ``tag``: one whole tag. ``text``: words for `Summary.contains`. ``until``: no run with a later id, so that a page of
    a list has the same runs when new ones come.
    """

    rig: str | None = None
    state: str | None = None
    verdict: str | None = None
    tag: str | None = None
    text: str = ""
    archived: bool = False
    until: str | None = None
    answered: bool = False
    rehearsal: bool | None = None
    uploaded: bool | None = None
    acceptance: str | None = None

    def contains(self, one: Summary) -> bool:
        """Return whether a row meets the conditions."""
        return (
            self.rig in (None, one.rig) and self.state in (None, one.state) and self.verdict in (None, one.verdict)
            and (self.tag is None or self.tag in one.tags) and one.contains(self.text)
            and (self.archived or not one.archived) and (self.until is None or one.id <= self.until)
            and (one.inertia_kg_m2 is not None or not self.answered)
            and self.rehearsal in (None, one.rehearsal) and self.uploaded in (None, one.uploaded)
            and self.acceptance in (None, one.acceptance)
        )

    def sql(self, without: Iterable[str] = ()) -> tuple[str, list[str | bool]]:
        """Return the conditions as SQL, with its values. ``without``: ids of runs that are left out."""
        where = ([] if self.archived else ["not archived"]) + ["inertia_kg_m2 is not null"] * self.answered
        values: list[str | bool] = []
        for text, value in (
            ("rig = ?", self.rig), ("state = ?", self.state), ("verdict = ?", self.verdict),
            ("rehearsal = ?", self.rehearsal), ("uploaded = ?", self.uploaded), ("acceptance = ?", self.acceptance),
            ("instr(', ' || tags || ', ', ', ' || ? || ', ')", self.tag), ("id <= ?", self.until),
            *((f"instr({SEARCHED_COLUMN}, ?)", word.casefold()) for word in self.text.split()),
            *(("id <> ?", one) for one in without),
        ):
            if value is not None:
                where.append(text)
                values.append(value)
        return f"where {' and '.join(where)}" if where else "", values


@dataclass(frozen=True)
class Order:
    """Order of a list: a key of `SORTS`, and whether the largest value comes first.

    Rows without a value come last. Rows with the same value follow each other from the newest to the oldest.
    """

    key: str = "id"
    down: bool = True

    @property
    def sql(self) -> str:
        """Return the order as SQL. Texts are compared without regard to upper and lower case of a to z."""
        way = "desc" if self.down else "asc"
        if self.key == "id":
            return f"order by id {way}"
        parts = (f"{name} is null, {name} collate nocase {way}" for name in SORTS[self.key])
        return f"order by {', '.join(parts)}, id desc"

    def sorted(self, rows: Iterable[T]) -> list[T]:
        """Return rows in this order, as the index does."""
        if self.key == "id":
            return sorted(rows, key=lambda one: one.id, reverse=self.down)
        found = sorted(rows, key=lambda one: one.id, reverse=True)
        for name in reversed(SORTS[self.key]):
            found.sort(key=lambda one: self._place(getattr(one, name)), reverse=self.down)
        return found

    def _place(self, value: Any) -> tuple[bool, Any]:
        missing = value is None
        folded = value.encode().lower() if isinstance(value, str) else value
        return (not missing if self.down else missing, 0 if missing else folded)


NEWEST: Final = Order()
