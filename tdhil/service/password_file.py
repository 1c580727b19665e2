"""A password in a file that an environment variable names: it stands on no command line."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tdhil.service.run_state import option_wrong


def read_password(variable: str, environment: Mapping[str, str]) -> str | None:
    """Return the password without its line end; None if the variable is not set. Raises UsageError."""
    if (name := environment.get(variable)) is None:
        return None
    try:
        return Path(name).read_text(encoding="utf-8").rstrip("\r\n")
    except (OSError, ValueError) as error:
        raise option_wrong(f"can't be read ({getattr(error, 'strerror', None) or 'no text'})", f"{variable} {name}",
                           "The file must contain only the password, readable by its owner only") from None
