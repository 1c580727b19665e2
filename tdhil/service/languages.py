"""Languages of the pages: catalogues of texts, the choice for a request, and numbers with the sign of the language.

A catalogue is a gettext file (``catalogues/de.po``): ``msgid`` is the English text of a template or a script, and
``msgstr`` its translation. It is read as it is, since a translator edits this file and a compiled copy could be older.
English needs no catalogue. Only the pages have a language: API, logs, audit and terminal stay English with a point.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from markupsafe import Markup, escape
from starlette.requests import HTTPConnection

from tdhil.buses import keys_by_flag
from tdhil.config import OF_A_TRACE, OF_EVIDENCE, OPTIONS
from tdhil.errors import MessageCode

FOLDER: Final = Path(__file__).with_name("catalogues")
COOKIE: Final = "tdhil-language"
"""Name of the cookie in which a page's switch keeps the chosen language."""
ENGLISH: Final = "en"
BETWEEN: Final = "\x04"
"""Sign between the context and the text of a key, as in gettext."""
_ROW: Final = re.compile(r'(?:(msgctxt|msgid|msgstr) )?("(?:[^"\\]|\\.)*")')
_HEADER: Final = re.compile(r"^([\w-]+): (.*)$", re.MULTILINE)
_PLACE: Final = re.compile(r"\{(\w+)\}")


class CatalogueWrong(ValueError):
    """A line of a catalogue can't be read."""


@dataclass(frozen=True)
class Language:
    """One language: its tag (``de``), its own name, its decimal sign, and its texts by key."""

    tag: str
    name: str
    decimal: str
    texts: Mapping[str, str]

    def word(self, text: str, context: str = "") -> str:
        """Return the translation of a text from the vocabulary, or the text itself."""
        return self.texts.get(f"{context}{BETWEEN}{text}" if context else text, text)

    def text(self, text: str, **values: Any) -> Markup:
        """Return the translation of a page's text, with each ``{name}`` replaced. Text and values are escaped."""
        return Markup(_PLACE.sub(lambda found: escape(values[found[1]]) if found[1] in values else found[0],
                                 escape(self.word(text))))

    def number(self, value: float) -> str:
        """Return a number of a page. Below 1000 it has four digits at most."""
        return f"{float(f'{value:.4g}') if abs(value) < 1000.0 else value:g}".replace(".", self.decimal)

    def labels(self) -> dict[str, str]:
        """Return how a page names each option of the command line, by its flag.

        It is the label of its field, else its key in the rig's file, else the command for a terminal.
        """
        in_file = self.word("{value} (rig's file)")
        names = {flag: in_file.replace("{value}", f"“{key}”") for flag, key in keys_by_flag().items()}
        for command, options in (("evidence", OF_EVIDENCE), ("replay", OF_A_TRACE), ("identify", OPTIONS)):
            for one in options:
                other = in_file.replace("{value}", f"“{one.at}”") if one.at else f"“tdhil {command} {one.flag}”"
                names[one.flag] = f"“{self.word(one.label)}”" if one.label else other
        return names

    def script(self) -> str:
        """Return the texts, the titles of the message codes and the labels of options as a script, in ASCII."""
        titles = {one.code: self.word(one.title, one.code) for one in MessageCode if self.texts}
        known = {"Texts": dict(self.texts), "Titles": titles, "Labels": self.labels()}
        return "".join(f"window.tdhil{name} = {json.dumps(found)};\n" for name, found in known.items())


def entries(text: str) -> list[dict[str, str]]:
    """Return the entries of a catalogue: each has msgid, msgstr, and perhaps msgctxt, comments and flags.

    An entry marked as obsolete is omitted. Raises CatalogueWrong.
    """
    found: list[dict[str, str]] = []
    for block in re.split(r"\n[ \t]*\n", text.strip()):
        entry: dict[str, str] = {}
        key = ""
        for row in block.splitlines():
            if row.startswith("#~"):
                continue
            if row.startswith("#"):
                kind = {"#,": "flags", "#:": "places"}.get(row[:2], "comment")
                entry[kind] = "\n".join(filter(None, (entry.get(kind, ""), row)))
                continue
            if (match := _ROW.fullmatch(row.strip())) is None or not (key := match[1] or key):
                raise CatalogueWrong(f"can't be read: {row[:60]}")
            entry[key] = entry.get(key, "") + ast.literal_eval(match[2])
        if "msgid" in entry:
            found.append(entry)
    return found


def language(text: str) -> Language:
    """Return the language of a catalogue's text. An empty or fuzzy entry is omitted. Raises CatalogueWrong."""
    head: dict[str, str] = {}
    texts = {}
    for one in entries(text):
        if one["msgid"] == "":
            head = dict(_HEADER.findall(one.get("msgstr", "")))
        elif one.get("msgstr") and "fuzzy" not in one.get("flags", ""):
            context = one.get("msgctxt")
            texts[one["msgid"] if context is None else f"{context}{BETWEEN}{one['msgid']}"] = one["msgstr"]
    try:
        return Language(head["Language"], head["X-Language-Name"], head["X-Decimal"], texts)
    except KeyError as error:
        raise CatalogueWrong(f"has no {error.args[0]} in its header") from None


def languages(folder: Path = FOLDER) -> dict[str, Language]:
    """Return English and the languages of a folder's catalogues, by tag. Raises CatalogueWrong."""
    known = [language(one.read_text(encoding="utf-8")) for one in sorted(folder.glob("*.po"))]
    return {one.tag: one for one in (Language(ENGLISH, "English", ".", {}), *known)}


def language_of(request: HTTPConnection, known: Iterable[str]) -> str:
    """Return the language for a request: that of the cookie, else the browser's first known one, else English."""
    tags = set(known)
    if (chosen := request.cookies.get(COOKIE)) in tags:
        return str(chosen)
    wanted: list[tuple[float, int, str]] = []
    for one in request.headers.get("accept-language", "")[:300].split(","):
        tag, _, quality = one.strip().lower().partition(";q=")
        try:
            wanted.append((-float(quality or 1.0), len(wanted), tag.split("-")[0]))
        except ValueError:
            continue
    return next((tag for quality, _, tag in sorted(wanted) if tag in tags and quality < 0.0), ENGLISH)
