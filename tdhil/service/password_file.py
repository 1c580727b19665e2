"""A password in a file that an environment variable names: it stands on no command line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tdhil.errors import MessageCode, UsageError


def read_password(variable: str, environment: Mapping[str, str]) -> str | None:
    """Return the password without its line end; None if the variable is not set. Raises UsageError."""
    if (name := environment.get(variable)) is None:
        return None
    try:
        return Path(name).read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, ValueError) as error:
        raise UsageError(f"can't be read ({getattr(error, 'strerror', None) or 'no text'})",
                         where=f"{variable} {name}",
                         next_step="The file must contain only the password, readable by its owner only",
                         entry=MessageCode.SERVICE_OPTION_WRONG) from None
