"""A new file that is whole, or is not there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_or_none(target: Path) -> Iterator[None]:
    """Remove a new file whose writing ends early: a part of it would pass for the whole."""
    try:
        yield
    except FileExistsError:
        raise                        # an earlier file, which stays
    except BaseException:
        target.unlink(missing_ok=True)
        raise
