"""Rows on the options in docs/reference/rig.md, made from the table of options.

``python -m tdhil.config.reference`` rewrites them in a clone; a test fails if they are not up to date.
"""

from collections.abc import Mapping
from pathlib import Path

from tdhil.config.options import OPTIONS, Option

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "rig.md"


def page_of(text: str) -> str:
    """Return the page with a row for each option, in place of its old row or below the rows of its section."""
    lines = text.splitlines()
    places = {line.split(" |")[0]: number for number, line in enumerate(lines)}
    new: list[tuple[int, str]] = []
    for one in OPTIONS:
        if (start := _start(one)) in places:
            lines[places[start]] = row_of(one)
        else:
            beside = (_start(other) for other in OPTIONS if _section(other) == _section(one))
            new.append((1 + max(places[row] for row in beside if row in places), row_of(one)))
    for number, row in sorted(new, key=lambda pair: -pair[0]):
        lines.insert(number, row)
    return "\n".join(lines) + "\n"


def row_of(option: Option) -> str:
    """Return the option's row: key, default, flag and meaning. Without a key: flag, keyword in Python and meaning."""
    meaning = option.more or option.help_text
    if option.unit is not None and option.unit.symbol != "1":
        meaning = f"{option.unit.symbol}{' ' if meaning.startswith('(') else '; '}{meaning}"
    if isinstance(option.choices, Mapping):
        meaning += ". " + "; ".join(f"`{name}`: {entry.text}" for name, entry in option.choices.items())
    elif option.allowed:
        *first, last = (f"`{name}`" for name in option.allowed)
        meaning += f": {', '.join(first)} or {last}"
    if not option.at:
        return f"{_start(option)} | {f'`{option.keyword}`' if option.python else ''} | {meaning} |"
    return f"{_start(option)} | {option.default_text or '–'} | `{option.flag}` | {meaning} |"


def _start(option: Option) -> str:
    return f"| `{option.at or option.flag}`"


def _section(option: Option) -> str:
    """Return the section of rig.yaml; '' for the top level, '-' for an option that no file states."""
    return option.at.rpartition(".")[0] if option.at else "-"


if __name__ == "__main__":
    PAGE.write_text(page_of(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
