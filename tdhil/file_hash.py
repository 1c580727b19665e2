"""SHA-256 of a file: the identity of a log in reports, calibrations and signatures."""

from __future__ import annotations

from hashlib import file_digest
from pathlib import Path

from tdhil.errors import UsageError


def sha256_of(path: Path, *, missing: str | None = None, name: str = "") -> str:
    """Return the hash in hex; ``missing`` without the file. Raises UsageError if the file can't be read.

    Without ``missing``, a file that is not there can't be read either. ``name``: of the file in the error,
    in place of its path.
    """
    try:
        with path.open("rb") as file:
            return file_digest(file, "sha256").hexdigest()
    except OSError as error:
        if missing is not None and isinstance(error, FileNotFoundError):
            return missing
        raise UsageError(f"can't be read ({error.strerror or error})", where=name or str(path)) from error
