"""MuJoCo's own viewer beside a run, where there is a display."""

import mujoco.viewer

from twin.plant.world import World

PERIOD = 1 / 30  # s of simulated time between pictures


class LiveViewer:
    """An observer of the loop that shows the world as it goes."""

    def __init__(self, world: World):
        self._world, self._next = world, 0.0
        self._handle = mujoco.viewer.launch_passive(
            world.model, world.data, show_left_ui=False, show_right_ui=False
        )

    def observe(self, tick) -> None:
        """Refresh the picture when it is due."""
        if self._world.time >= self._next and self._handle.is_running():
            self._next = self._world.time + PERIOD
            self._handle.sync()

    def close(self) -> None:
        """Close the window."""
        self._handle.close()
