"""The calibration order of the photoelectric network: from stop to stop, listening at each."""

from typing import TYPE_CHECKING

from twin.messages import BeaconOrder
from twin.stack.estimation.beacon_calibration import BeaconCalibrationRun
from twin.stack.tasks.mission import Act, Behaviour, sequence

if TYPE_CHECKING:
    from twin.stack.stack import Stack

REST = 0.3  # s after a leg until the vehicle stands still


def beacon_mission(stack: "Stack") -> Behaviour:
    """Drive the order's stops; the turns of the head that are heard there are kept."""
    assert isinstance(stack.order, BeaconOrder)
    stack.head = BeaconCalibrationRun(stack.config)
    steps = []
    for i, stop in enumerate(stack.order.stops):
        steps += [stack.straight(f"to stop {i + 1}", stop), _Rest(stack), _Listen(stack)]
    return sequence("calibrate the head", *steps)


class _Rest(Act):
    """Stands until the wheels are said to stand."""

    def __init__(self, stack: "Stack"):
        began = [0.0]
        super().__init__(
            "come to rest",
            done=lambda: stack.localiser.standing and stack.now >= began[0] + REST,
            start=lambda: began.__setitem__(0, stack.now),
        )


class _Listen(Act):
    """Stands and listens for the order's dwell."""

    def __init__(self, stack: "Stack"):
        self._until, self._stack = 0.0, stack
        super().__init__("listen to the network", done=self._over, start=self._begin)

    def _begin(self) -> None:
        stack = self._stack
        assert isinstance(stack.order, BeaconOrder) and stack.head is not None
        self._until = stack.now + stack.order.dwell
        fused = stack.localiser.fused
        stack.head.begin(stack.now, fused.pose(stack.now), fused.covariance)

    def _over(self) -> bool:
        if self._stack.now < self._until:
            return False
        assert self._stack.head is not None
        self._stack.head.end()
        return True
