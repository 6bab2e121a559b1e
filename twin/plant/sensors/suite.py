"""When each sensor looks, and when the stack hears of it.

A reading carries the time of its exposure and arrives `latency` later. Both are simulated time, so
that the run does not depend on how fast this computer is: a picture may be rendered by a worker
while physics goes on, and is waited for only when it is due.
"""

from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any, Protocol

from twin.messages import Reading

EPSILON = 1e-6  # s, well below a physics step


class Sensor(Protocol):
    """One sensor. `period` between exposures and `latency` from exposure to arrival, seconds."""

    period: float
    latency: float

    def sample(self, stamp: float, model: Any, data: Any) -> Reading | Future[Any] | None:
        """Expose now. Reads truth, draws its own noise. None if it is switched off."""
        ...


class SensorSuite:
    """Samples sensors at their own rates and hands over what has arrived.

    Args:
        sensors: in the order in which readings of equal arrival time are delivered.
        latency_scale: factor on every latency.
    """

    def __init__(self, sensors: Sequence[Sensor], latency_scale: float = 1.0):
        self._sensors = tuple(sensors)
        self._latency_scale = latency_scale
        self._exposures = [0] * len(self._sensors)  # made so far
        self._pending: list[tuple[float, int, Reading | Future[Any]]] = []

    def sample(self, stamp: float, model, data) -> None:
        """Expose every sensor that is due. Call once at each physics step, also at time zero.

        The n-th exposure falls on the first step at or after n periods, so rates that are no
        multiple of the step keep their mean.
        """
        for index, sensor in enumerate(self._sensors):
            if stamp < self._exposures[index] * sensor.period - EPSILON:
                continue
            self._exposures[index] += 1
            reading = sensor.sample(stamp, model, data)
            if reading is not None:
                arrival = stamp + sensor.latency * self._latency_scale
                self._pending.append((arrival, index, reading))

    def arrived(self, now: float) -> tuple[Reading, ...]:
        """Readings whose arrival time has passed, by arrival, then by order of the sensors."""
        due = [entry for entry in self._pending if entry[0] <= now + EPSILON]
        self._pending = [entry for entry in self._pending if entry[0] > now + EPSILON]
        due.sort(key=lambda entry: entry[:2])
        return tuple(r.result() if isinstance(r, Future) else r for _, _, r in due)
