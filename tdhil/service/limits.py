"""Limits that `tdhil serve --help` shows. No large library is imported here."""

from typing import Final

MEBIBYTE: Final = 2**20
UPLOAD_LIMIT: Final = 256 * MEBIBYTE
"""Largest uploaded recording, bytes, unless `--upload-limit` states another one. An hour at 1 kHz has about 100 MiB."""
MOST_UPLOAD: Final = 4096 * MEBIBYTE
"""Largest limit that can be stated, bytes: the reader of traces takes no larger file."""
