"""One run of plant and stack with its recorders: what every scenario needs around its loop."""

from collections.abc import Callable, Mapping, Sequence

from evaluation.belief import belief
from evaluation.report import metrics_page
from evaluation.run import Criterion, RunRequest, RunResult
from evaluation.trajectories import TrajectoryMonitor
from twin.layout import Layout, LayoutError
from twin.loop import Loop, Observer, Tick
from twin.messages import AnyOrder
from twin.plant.live_viewer import LiveViewer
from twin.plant.plant import Plant
from twin.recording.log import ReadingsLog
from twin.recording.viewer_log import ViewerLog
from twin.stack.config import StackConfig
from twin.stack.control_unit import ControlUnit
from twin.stack.detection.card import NetworkError
from twin.stack.stack import Stack

WARM_UP = 2.0  # s left out of the real-time factor


class Simulation:
    """Builds a run, ticks it, and closes it again (a context manager).

    Args:
        request: what was asked for on the command line.
        layout: what stands where, and what goes wrong.
        order: sent to the stack at the start; without one the layout's pick order.
        observers: called after every tick; the paths are always followed.
        config: the stack's belief; that of the layout without one.
        counts: numbers for the recording's plots, by name.

    Raises:
        LayoutError: the layout cannot be built, or names a file that cannot be used.
    """

    def __init__(
        self,
        request: RunRequest,
        layout: Layout,
        order: AnyOrder | None = None,
        observers: Sequence[Observer] = (),
        config: StackConfig | None = None,
        counts: Callable[[], Mapping[str, float]] = dict,
    ):
        self.request = request
        self.config = config or belief(layout)
        self.plant = Plant(layout, request.seed, order)
        try:
            self.stack = Stack(self.config)
        except NetworkError as error:
            self.plant.close()
            raise LayoutError(f"options.detector: {error}") from None
        self.plant.park([w.motion.rest for w in self.stack.arms])
        self.paths = TrajectoryMonitor()
        self._page: Callable[[str], None] | None = None
        watchers: list = []
        if request.record:
            log = ViewerLog(request.out / "recording.rrd", self.plant.world, self.config, counts)
            self._page = log.metrics
            watchers.append(log)
        if request.log:
            watchers.append(ReadingsLog(request.out / "readings.log", self.config))
        if request.viewer:
            watchers.append(LiveViewer(self.plant.world))
        self._watchers = watchers
        unit = ControlUnit(self.config.wheels)
        self.loop = Loop(self.plant, self.stack, unit, (self.paths, *observers, *watchers))
        self._warm = (0.0, 0.0)

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(self, *error) -> None:
        for watcher in self._watchers:
            watcher.close()
        self.plant.close()

    def run(self, longest: float, over: Callable[[Tick], bool]) -> bool:
        """Tick until `over`; False if time ran out or the run was interrupted.

        Args:
            longest: simulated s after which it is given up; a `--duration` comes before.
            over: whether the scenario has come to its end.
        """
        longest = self.request.duration or longest
        try:
            while self.plant.time < longest - 1e-9:
                tick = self.loop.tick()
                if self._warm[0] == 0.0 and self.plant.time >= WARM_UP:
                    self._warm = (self.plant.time, self.loop.busy_s)
                self.request.progress(self.plant.time, longest, tick.state.task)
                if over(tick):
                    return True
        except KeyboardInterrupt:
            pass  # what was measured so far is reported, marked incomplete
        return False

    def result(
        self,
        metrics: dict[str, float],
        criteria: list[Criterion],
        complete: bool,
        notes: Sequence[str] = (),
    ) -> RunResult:
        """What the scenario hands back; call before the context is left."""
        if self._page is not None:
            self._page(metrics_page(metrics))
        timed, busy = self.plant.time - self._warm[0], self.loop.busy_s - self._warm[1]
        return RunResult(
            metrics=metrics,
            criteria=criteria,
            sim_time=self.plant.time,
            wall_time=self.loop.busy_s,
            rtf=timed / busy if self._warm[0] and busy > 0 else float("nan"),
            complete=complete,
            trajectories=self.paths.trajectories(),
            notes=[*notes, *self.failure_notes(), *self.collision_notes()],
        )

    def failure_notes(self) -> list[str]:
        """With what the order was given up, if it was."""
        return [f"order given up: {self.stack.failure}"] if self.stack.failure else []

    def collision_notes(self) -> list[str]:
        """Onsets of contacts that should not have been, one line each."""
        return [
            f"{c.stamp:.2f} s: collision {c.kind}: {c.first}, {c.second}"
            for c in self.plant.world.collisions
        ]
