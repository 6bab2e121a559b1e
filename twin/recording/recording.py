"""Everything that `--record` leaves behind, as one observer of the loop."""

from pathlib import Path
from typing import TYPE_CHECKING

from twin.recording.log import ReadingsLog
from twin.recording.viewer_log import ViewerLog
from twin.stack.config import StackConfig

if TYPE_CHECKING:
    from twin.loop import Tick
    from twin.plant.world import World


class Recording:
    """`recording.rrd` for the viewer and `readings.log` for replay. Use it in a `with` statement.

    Args:
        folder: receives both files.
        world: the cell.
        config: what the stack was told.
    """

    def __init__(self, folder: Path, world: "World", config: StackConfig):
        self.viewer = ViewerLog(folder / "recording.rrd", world, config)
        self.log = ReadingsLog(folder / "readings.log", config.site, config.options)

    def observe(self, tick: "Tick") -> None:
        """Record a tick."""
        self.log.write(tick.stamp, tick.readings, tick.commands)
        self.viewer.observe(tick)

    def close(self) -> None:
        """Close both files."""
        try:
            self.viewer.close()
        finally:
            self.log.close()

    def __enter__(self) -> "Recording":
        return self

    def __exit__(self, *_) -> None:
        self.close()
