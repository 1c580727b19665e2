"""Letterhead of a site: company, address and logo, at the head of every report. Pure, except `load_letterhead`.

The logo is a PNG. An SVG may contain scripts and references to other hosts, and the PDF cannot show it, so it is
refused. `clean_logo` keeps nothing but the picture: no text, no metadata, and no bytes after its end.
"""

from __future__ import annotations

import struct
import zlib
from base64 import b64decode, b64encode
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field

from profiles import DataModel, load_with_lines
from tdhil.errors import MessageCode, UsageError

LARGEST_LOGO: Final = 256 * 1024
"""Largest file of a logo, bytes. A logo of 1200 by 400 pixels has about 60 kB; each report contains it."""
MOST_PIXELS: Final = 4_000_000
"""Largest number of pixels of a logo. A picture across an A4 page at 300 dpi has 2480 columns."""
LONGEST_LINE: Final = 120
"""Longest company and line of the address, characters."""
MOST_LINES: Final = 6
"""Largest number of lines of the address."""

_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_DEPTHS: Final = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
"""Bit depths of each colour type (PNG specification, table 11.1)."""
_SAMPLES: Final = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Samples of a pixel of each colour type (PNG specification, section 6.2)."""
_LAST_FILTER: Final = 4
"""Largest filter type of a row (PNG specification, section 9.2)."""
_EXPORT: Final = "Export the logo as PNG, such as 1200 by 400 pixels"


@dataclass(frozen=True)
class Letterhead:
    """Head of a report. ``address``: its lines. ``logo``: a PNG from `clean_logo`, b'' without one."""

    company: str = ""
    address: tuple[str, ...] = ()
    logo: bytes = b""

    def __bool__(self) -> bool:
        return bool(self.company or self.address or self.logo)

    @property
    def logo_size(self) -> tuple[int, int]:
        """Return width and height of the logo in pixels; (0, 0) without one."""
        start = len(_SIGNATURE) + 8
        return struct.unpack(">II", self.logo[start : start + 8]) if self.logo else (0, 0)

    @property
    def logo_text(self) -> str:
        """Return the logo in base64."""
        return b64encode(self.logo).decode()

    def plain(self) -> dict[str, Any]:
        """Return the letterhead as plain data for JSON."""
        return {"company": self.company, "address": list(self.address), "logo": self.logo_text}

    @staticmethod
    def of_plain(plain: Mapping[str, Any]) -> Letterhead:
        """Read a letterhead, and check its logo again. Raises UsageError; ValueError or TypeError for other data."""
        logo = b64decode(plain.get("logo") or "", validate=True)
        return Letterhead(str(plain.get("company") or ""), tuple(map(str, plain.get("address") or ())),
                          clean_logo(logo) if logo else b"")


NO_LETTERHEAD: Final = Letterhead()


class _LetterheadFile(DataModel):
    """letterhead.yaml. ``logo``: a PNG; a relative path starts in the folder of this file."""

    company: Annotated[str, Field(max_length=LONGEST_LINE)] = ""
    address: tuple[Annotated[str, Field(max_length=LONGEST_LINE)], ...] = Field(default=(), max_length=MOST_LINES)
    logo: Annotated[str, Field(min_length=1)] | None = None


def load_letterhead(path: Path | None) -> Letterhead:
    """Return the letterhead in a file; an empty one for None. Raises DataFileError, and UsageError for its logo."""
    if path is None:
        return NO_LETTERHEAD
    found = load_with_lines(path, _LetterheadFile).value
    if found.logo is None:
        return Letterhead(found.company, found.address)
    named = path.parent / found.logo
    try:
        with named.open("rb") as file:
            data = file.read(LARGEST_LOGO + 1)
    except OSError as error:
        raise UsageError(f"can't be read ({error.strerror or error})", where=str(named),
                         entry=MessageCode.VALUE_NOT_ALLOWED) from error
    return Letterhead(found.company, found.address, clean_logo(data, str(named)))


def clean_logo(data: bytes, where: str = "logo") -> bytes:
    """Return a PNG with nothing but the picture of this one. Raises UsageError for another or a damaged file."""
    if len(data) > LARGEST_LOGO:
        raise _refused(f"the logo has more than {LARGEST_LOGO // 1024} KiB", where, "Export it with fewer pixels")
    if data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        raise _refused("this is an SVG, or another document of text. It may contain scripts and references to other "
                       "hosts, and the PDF cannot show it", where)
    if not data.startswith(_SIGNATURE):
        raise _refused("this is no PNG", where)
    try:
        return _cleaned(data, where)
    except (struct.error, zlib.error, StopIteration) as error:
        raise _refused("this PNG is damaged", where) from error


def _cleaned(data: bytes, where: str) -> bytes:
    chunks = _chunks(data)
    kind, header = next(chunks)
    if kind != b"IHDR":
        raise zlib.error("the header is missing")
    width, height, depth, colour, compression, filtering, interlaced = struct.unpack(">IIBBBBB", header)
    if depth not in _DEPTHS.get(colour, ()) or compression or filtering or not width or not height:
        raise zlib.error("the header is wrong")
    if width * height > MOST_PIXELS:
        raise _refused(f"the logo has {width} by {height} pixels; {MOST_PIXELS / 1e6:g} million pixels is the limit",
                       where)
    if interlaced:
        raise _refused("this PNG is interlaced", where, "Export it without interlacing")
    kept: dict[bytes, bytes] = {b"IHDR": header}
    body = b""
    for kind, content in chunks:
        if kind == b"IDAT":
            body += content
        elif kind in (b"PLTE", b"tRNS"):
            kept[kind] = content
    if (colour == 3) != (b"PLTE" in kept) and colour in (0, 3, 4):
        raise zlib.error("the palette is missing, or not allowed")
    row = 1 + (width * depth * _SAMPLES[colour] + 7) // 8
    packer = zlib.decompressobj()
    pixels = packer.decompress(body, row * height + 1)      # not more, whatever the file claims
    if len(pixels) != row * height or max(pixels[::row]) > _LAST_FILTER:
        raise zlib.error("the picture is not complete")
    parts: list[tuple[bytes, bytes]] = [(kind, kept[kind]) for kind in (b"IHDR", b"PLTE", b"tRNS") if kind in kept]
    parts += [(b"IDAT", zlib.compress(pixels, 9)), (b"IEND", b"")]
    return _SIGNATURE + b"".join(
        struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        for kind, content in parts)


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield (kind, content) of each chunk up to IEND. Raises struct.error and zlib.error for a damaged one."""
    at = len(_SIGNATURE)
    while True:
        length, kind = struct.unpack_from(">I4s", data, at)
        content = data[at + 8 : at + 8 + length]
        (checked,) = struct.unpack_from(">I", data, at + 8 + length)
        if checked != zlib.crc32(kind + content):
            raise zlib.error("a checksum is wrong")
        if kind == b"IEND":
            return
        yield kind, content
        at += 12 + length


def _refused(what: str, where: str, next_step: str = _EXPORT) -> UsageError:
    return UsageError(what, where=where, next_step=next_step, entry=MessageCode.VALUE_NOT_ALLOWED)
