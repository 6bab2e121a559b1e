"""The log of readings and commands: what went into the stack and what came out, tick by tick.

Everything that is needed to run the stack again stands in it, its belief and its maps too, and
nothing of the plant; it is read where no simulator is installed. The arm's model file alone is
taken from where it is read. A log broken off in the middle of a record reads up to there.
"""

import struct
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from twin.layout import Options
from twin.messages import Commands, Reading
from twin.recording.codec import decode, encode
from twin.site import Site
from twin.stack.config import StackConfig, nominal_config
from twin.stack.estimation.map_file import load_map, save_map
from twin.stack.estimation.occupancy_grid import OccupancyGrid

if TYPE_CHECKING:  # the loop brings the plant with it, which a replay does not have
    from twin.loop import Tick

_MAGIC = b"TWINLOG2"
_LENGTHS = struct.Struct("<II")  # of text and payload
_BACKLOG = 50  # records in memory before the run waits for the disk
_MAPS = ("lidar", "fused")  # that a stack with `options.map` reads
_APART = ("site", "options", "arm_model")  # fields of a belief that are not written as messages


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
        config: the belief that the stack was given.
    """

    def __init__(self, path: Path, config: StackConfig):
        self._file = path.open("wb")
        self._file.write(_MAGIC)
        self._worker = ThreadPoolExecutor(1, "readings-log")
        self._pending: deque[Future[None]] = deque()
        self._write(_header(config))

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


def read_config(path: Path, folder: Path | None = None) -> StackConfig:
    """The belief that the logged stack was given.

    Args:
        path: of the log.
        folder: receives the maps that it drove by, if it did.

    Raises:
        ValueError: one line: not a log, or maps and no folder for them.
    """
    with path.open("rb") as file:
        header = next(_records(file, path), None)
    if header is None:
        raise ValueError(f"{path}: broken off before anything was logged")
    options = Options.model_validate_json(header["options"])
    if header["maps"]:
        if folder is None:
            raise ValueError(f"{path}: its stack drove by a map: a folder is needed for that")
        folder.mkdir(parents=True, exist_ok=True)
        for name, (origin, resolution, log_odds) in header["maps"].items():
            save_map(OccupancyGrid(origin, resolution, log_odds), folder / f"{name}.yaml")
        options = options.model_copy(update={"map": str(folder)})
    nominal = nominal_config(Site.model_validate_json(header["site"]), options)
    return replace(nominal, **header["belief"])


def read_log(path: Path) -> Iterator[LoggedTick]:
    """Ticks of a log, in order."""
    with path.open("rb") as file:
        records = _records(file, path)
        next(records)
        for stamp, readings, commands in records:
            yield LoggedTick(stamp, readings, commands)


def _header(config: StackConfig) -> dict[str, Any]:
    """What the stack is given before its first reading."""
    folder, maps = config.options.map, {}
    for name in _MAPS if folder is not None else ():
        grid = load_map(Path(folder or "") / f"{name}.yaml")
        maps[name] = (np.asarray(grid.origin), grid.resolution, grid.log_odds)
    return {
        "site": config.site.model_dump_json(),
        "options": config.options.model_dump_json(),
        "belief": {f.name: getattr(config, f.name) for f in fields(config) if f.name not in _APART},
        "maps": maps,
    }


def _records(file: BinaryIO, path: Path) -> Iterator:
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ValueError(f"{path}: not a log of readings")
    while len(lengths := file.read(_LENGTHS.size)) == _LENGTHS.size:
        size, payload_size = _LENGTHS.unpack(lengths)
        text, payload = file.read(size), file.read(payload_size)
        if len(payload) < payload_size or len(text) < size:
            return
        yield decode(text, payload)
