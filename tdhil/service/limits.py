"""Limits that `tdhil serve --help` shows. No large library is imported here."""

from typing import Final

from drivers import LONGEST_STOP_S

API: Final = "/api/v1"
"""Beginning of the path of each request."""
MEBIBYTE: Final = 2**20
UPLOAD_LIMIT: Final = 256 * MEBIBYTE
"""Largest uploaded recording, bytes, unless `--upload-limit` states another one. An hour at 1 kHz has about 100 MiB."""
MOST_UPLOAD: Final = 4096 * MEBIBYTE
"""Largest limit that can be stated, bytes: the reader of traces takes no larger file."""
OPEN_S: Final = 30.0
"""Time allowed to `tdhil stop` to start its process, and to open the bus and close it, s."""
STOP_S: Final = LONGEST_STOP_S + OPEN_S
"""Longest duration of `tdhil stop` for a shaft that keeps turning, s."""
REPLY_S: Final = STOP_S + 10.0
"""Longest wait of a client for a reply, s: a Stop of a rig without a run is answered after standstill."""
