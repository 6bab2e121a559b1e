"""The log of readings and commands: what went into the stack and what came out, tick by tick.

Everything that is needed to run the stack again stands in it, and nothing of the plant; it is read
where no simulator is installed. A log broken off in the middle of a record reads up to there.
"""

import struct
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from twin.layout import Options
from twin.messages import Commands, Reading
from twin.recording.codec import decode, encode
from twin.site import Site

if TYPE_CHECKING:  # the loop brings the plant with it, which a replay does not have
    from twin.loop import Tick

_MAGIC = b"TWINLOG1"
_LENGTHS = struct.Struct("<II")  # of text and payload
_BACKLOG = 50  # records in memory before the run waits for the disk


@dataclass(frozen=True)
class LoggedTick:
    """One tick of the stack."""

    stamp: float
    readings: tuple[Reading, ...]
    commands: Commands


class ReadingsLog:
    """Writes a log. Packing pictures takes longer than a tick, so a worker does it.

    Args:
        path: file to write.
        site: the drawing that the stack was given.
        options: the options that it was given.
    """

    def __init__(self, path: Path, site: Site, options: Options):
        self._file = path.open("wb")
        self._file.write(_MAGIC)
        self._worker = ThreadPoolExecutor(1, "readings-log")
        self._pending: deque[Future[None]] = deque()
        self._write({"site": site.model_dump_json(), "options": options.model_dump_json()})

    def observe(self, tick: "Tick") -> None:
        """Append what went into the stack and what came out."""
        self.write(tick.stamp, tick.readings, tick.commands)

    def write(self, stamp: float, readings: tuple[Reading, ...], commands: Commands) -> None:
        """Append a tick. The messages must not change afterwards."""
        self._pending.append(self._worker.submit(self._write, (stamp, readings, commands)))
        while len(self._pending) > _BACKLOG or (self._pending and self._pending[0].done()):
            self._pending.popleft().result()

    def close(self) -> None:
        """Write what is left and close the file."""
        try:
            while self._pending:
                self._pending.popleft().result()
        finally:
            self._worker.shutdown()
            self._file.close()

    def _write(self, record) -> None:
        text, payload = encode(record)
        self._file.write(_LENGTHS.pack(len(text), len(payload)) + text + payload)


def read_setting(path: Path) -> tuple[Site, Options]:
    """Drawing and options that the logged stack was given."""
    with path.open("rb") as file:
        setting = next(_records(file, path))
    return (
        Site.model_validate_json(setting["site"]),
        Options.model_validate_json(setting["options"]),
    )


def read_log(path: Path) -> Iterator[LoggedTick]:
    """Ticks of a log, in order."""
    with path.open("rb") as file:
        records = _records(file, path)
        next(records)
        for stamp, readings, commands in records:
            yield LoggedTick(stamp, readings, commands)


def _records(file: BinaryIO, path: Path) -> Iterator:
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ValueError(f"{path}: not a log of readings")
    while len(lengths := file.read(_LENGTHS.size)) == _LENGTHS.size:
        size, payload_size = _LENGTHS.unpack(lengths)
        text, payload = file.read(size), file.read(payload_size)
        if len(payload) < payload_size or len(text) < size:
            return
        yield decode(text, payload)
