"""Keywords of the Python functions, from the table of options."""

import inspect
import os
from collections.abc import Callable, Collection, Mapping
from typing import Any, Final, TypeVar

from tdhil.config.options import ASKED_AGAIN, OPTIONS, Option, Topic
from tdhil.errors import MessageCode, UsageError

_OF_THE_DRIVE = frozenset({Topic.DRIVE, Topic.SIMULATED})
OF_THE_RUN: Final = tuple(one for one in OPTIONS if one.python and one.group not in _OF_THE_DRIVE)
"""Keywords of `tdhil.run`."""
OF_THE_SIMULATOR: Final = tuple(one for one in OPTIONS if one.python and one.group in _OF_THE_DRIVE)
"""Keywords of `tdhil.simulate`."""
OF_THE_RESULT: Final = ASKED_AGAIN
"""Keywords of `tdhil.identify`."""

_Function = TypeVar("_Function", bound=Callable[..., Any])


def with_keywords(options: Collection[Option]) -> Callable[[_Function], _Function]:
    """Show the options in the signature of a function that takes them as ``**options``."""

    def shown(function: _Function) -> _Function:
        found = inspect.signature(function)
        own = [one for one in found.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
        more = [inspect.Parameter(one.keyword, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=one.kind | None)
                for one in options]
        function.__signature__ = found.replace(parameters=[*own, *more])  # type: ignore[attr-defined]
        return function

    return shown


def values_of(options: Collection[Option], given: Mapping[str, Any], function: str) -> dict[str, Any]:
    """Return values by option name from keywords; None means not given. Raises UsageError for unknown keywords."""
    names = {one.keyword: one.name for one in options}
    if unknown := sorted(set(given) - set(names)):
        raise UsageError(f"unknown option: {', '.join(unknown)}", where=function,
                         next_step=f"Use one of: {', '.join(names)}", entry=MessageCode.UNKNOWN_OPTION)
    return {names[keyword]: os.fspath(value) if isinstance(value, os.PathLike) else value
            for keyword, value in given.items() if value is not None}
