"""The pick order: drive to the line, pick off the belt, deliver (Li & An 2025, Fig. 6)."""

from typing import TYPE_CHECKING

from twin.messages import Goal, Order
from twin.stack.grasping.intercept import arm_start_delay
from twin.stack.tasks.mission import Act, Behaviour, sequence, together

if TYPE_CHECKING:
    from twin.stack.stack import Stack


def pick_mission(stack: "Stack") -> Behaviour:
    """By map to the line's approach, straight in while the arms make ready, pick, and away."""
    site, line = stack.config.site, AtLine(stack)
    return sequence(
        "pick order",
        stack.go(Goal("pick approach", site.pick_approach)),
        together(
            "dock at line",
            stack.straight("drive to line", site.pick),
            Act("ready arms", line.arms_ready, line.begin),
        ),
        Act("pick", line.picked, line.start),
        Act("stow arms", line.arms_idle, line.stow),
        stack.straight("leave line", site.pick_leave),
        stack.go(Goal("receiving", site.receiving)),
    )


class AtLine:
    """What is asked and told while the arms work at the line."""

    def __init__(self, stack: "Stack"):
        self._stack = stack
        self._arms_sent = False

    def begin(self) -> None:
        self._stack.distance.reset()
        self._stack.watch_belt()

    def arms_ready(self) -> bool:
        """Sends the arms over the belt so that they are there when the vehicle stops."""
        stack = self._stack
        if not stack.config.options.grasp_timing:
            return True
        if not self._arms_sent:
            workers = stack.picker.workers
            needed = max(w.motion.duration_to(stack.now, w.motion.ready_position) for w in workers)
            S = stack.distance.distance(stack.pose)
            speed = float(stack.localiser.velocity[0])
            if arm_start_delay(S, speed, stack.config.drive.acceleration, needed) <= 0.0:
                for w in workers:
                    w.motion.go_ready(stack.now)
                self._arms_sent = True
        return self._arms_sent

    def start(self) -> None:
        assert isinstance(self._stack.order, Order)
        self._stack.picker.start(self._stack.now, self._stack.order)

    def picked(self) -> bool:
        if not self._stack.picker.finished(self._stack.now):
            return False
        self._stack.picker.active = False
        self._stack.on_picture = None
        return True

    def stow(self) -> None:
        for worker in self._stack.arms:
            worker.motion.go_stow(self._stack.now)

    def arms_idle(self) -> bool:
        now = self._stack.now
        return all(w.free and w.motion.idle(now) for w in self._stack.arms)
