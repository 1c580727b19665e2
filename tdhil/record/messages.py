"""The messages of our channels in a file that may be anything."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from tdhil.record import chunk
from tdhil.record.errors import LogError
from tdhil.record.inflate import Contents, Damage
from tdhil.recording.log_format import CHANNELS, PACKAGE, schema_name
from tdhil.recording.mcap_container import MAGIC
from tdhil.recording.mcap_recovery import Library, Whole, walk

_NUMBER: Final = {(topic, schema_name(message)): number for number, (topic, message) in CHANNELS.items()}
_OTHER: Final = "Give a run.mcap of this tool"


class Ours(NamedTuple):
    """One message on one of our channels, not decoded yet; ``number`` is the channel's in `channels`."""

    number: int
    payload: bytes
    log_time_ns: int


def messages(path: Path, *, salvage: bool = False) -> Iterator[Ours | Damage | Whole]:
    """Messages of ours, what was stepped over, and at the end `Whole` if the file was closed.

    Raises `LogError` where the file can't be opened, is empty, is not MCAP, or (at the end) holds nothing of ours.
    ``salvage``: a file that doesn't begin like MCAP is searched all the same, since its head may be what was hit.
    """
    declared = _Declared()
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            file.seek(0)
            if size == 0:
                raise LogError("the file is empty", where=str(path), next_step="The run has to be done again")
            if file.read(len(MAGIC)) != MAGIC[:size]:
                if not salvage:
                    raise LogError("this is not an MCAP file", where=str(path), next_step=_OTHER)
                yield Damage(0, "the file does not begin like MCAP")
                declared.assume()
            for found in walk(file, size):
                if isinstance(found, Contents):
                    yield from declared.messages(found)
                elif isinstance(found, Library):
                    declared.library(found.name)
                else:
                    if salvage and isinstance(found, Damage):
                        declared.assume_undeclared()       # it may have been what declares the channels
                    yield found
    except OSError as error:
        raise LogError(f"the log can't be read: {error.strerror or error}", where=str(path),
                       next_step="Check the path") from error
    if not declared.ours:
        what = "nothing of a run of this tool is in it" if salvage else "an MCAP file, but not a run of this tool"
        raise LogError(what, where=str(path), next_step=_OTHER)


class _Declared:
    """Which channel of the file is which of ours, by topic and schema."""

    def __init__(self) -> None:
        self.ours = False
        self._schemas: dict[int, str] = {}
        self._numbers: dict[int, int] = {}

    def library(self, name: str) -> None:
        """Our own files: the channels are known even if the chunk that declares them is lost."""
        if name.split(" ", maxsplit=1)[0] == PACKAGE:
            self.ours = True
            self._numbers = {number: number for number in CHANNELS} | self._numbers

    def assume(self) -> None:
        """Nothing is known of who wrote it: what can't be one of our files' chunks must show by itself."""
        self._numbers = {number: number for number in CHANNELS}

    def assume_undeclared(self) -> None:
        """Where nothing was declared so far: our own numbers."""
        if not self._schemas:
            self._numbers = {number: number for number in CHANNELS} | self._numbers

    def messages(self, contents: Contents) -> Iterator[Ours | Damage]:
        numbers = self._numbers
        try:
            for record in chunk.records(contents.data):
                if isinstance(record, chunk.Message):
                    if record.channel in numbers:
                        self.ours = True
                        yield Ours(numbers[record.channel], record.payload, record.log_time_ns)
                elif isinstance(record, chunk.Schema):
                    self._schemas[record.identifier] = record.name
                else:
                    self._channel(record)
        except ValueError as error:
            yield Damage(contents.offset, f"a chunk is malformed: {error}")

    def _channel(self, record: chunk.Channel) -> None:
        number = _NUMBER.get((record.topic, self._schemas.get(record.schema, "")))
        self._numbers.pop(record.identifier, None)
        if number is not None:
            self.ours = True
            self._numbers[record.identifier] = number
