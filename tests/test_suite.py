"""Exposure and arrival of readings."""

import time
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest

from twin.messages import ImuReading
from twin.plant.sensors.suite import SensorSuite

STEP = 0.002


class Clockwork:
    """A sensor whose reading tells its own time and name."""

    def __init__(self, period, latency, name=0.0, worker=None):
        self.period, self.latency, self._name, self._worker = period, latency, name, worker

    def sample(self, stamp, model, data):
        reading = ImuReading(stamp, np.full(3, self._name), np.zeros(3))
        if self._worker is None:
            return reading

        def slow():
            time.sleep(0.002)
            return reading

        return self._worker.submit(slow)


def deliveries(sensors, seconds, scale=1.0):
    """(arrival tick, stamp, name) of every reading."""
    suite, rows = SensorSuite(sensors, scale), []
    suite.sample(0.0, None, None)
    for k in range(1, round(seconds / STEP) + 1):
        now = k * STEP
        suite.sample(now, None, None)
        if k % 5 == 0:
            rows += [(now, r.stamp, r.accel[0]) for r in suite.arrived(now)]
    return np.array(rows).reshape(-1, 3)


@pytest.mark.parametrize("latency", [0.0, 0.002, 0.010, 0.025])
def test_reading_arrives_at_the_first_tick_after_its_latency(latency):
    rows = deliveries([Clockwork(0.01, latency)], 0.5)
    late = rows[1:, 0] - rows[1:, 1]
    assert np.all(late >= latency - 1e-9) and np.all(late < latency + 0.01 - 1e-9)


def test_doubling_the_latency_shifts_every_delivery():
    once = deliveries([Clockwork(0.02, 0.03)], 0.5)
    twice = deliveries([Clockwork(0.02, 0.03)], 0.5, scale=2.0)
    n = len(twice)
    np.testing.assert_array_equal(once[:n, 1], twice[:, 1])
    np.testing.assert_allclose(twice[:, 0] - once[:n, 0], 0.03, atol=1e-9)


def test_a_rate_that_is_no_multiple_of_the_step_keeps_its_mean():
    rows = deliveries([Clockwork(1 / 30, 0.0)], 10.0)
    assert len(rows) == 301
    np.testing.assert_allclose(rows[:, 1], np.arange(301) / 30, atol=STEP)


def test_equal_arrivals_come_in_the_order_of_the_sensors():
    rows = deliveries([Clockwork(0.01, 0.004, 1.0), Clockwork(0.01, 0.004, 2.0)], 0.1)
    np.testing.assert_array_equal(rows[:, 2], np.tile([1.0, 2.0], len(rows) // 2))


def test_a_reading_from_a_worker_arrives_as_if_it_had_been_made_at_once():
    with ThreadPoolExecutor(1) as worker:
        slow = deliveries([Clockwork(0.02, 0.01, worker=worker)], 0.3)
    np.testing.assert_array_equal(slow, deliveries([Clockwork(0.02, 0.01)], 0.3))


def test_a_worker_is_waited_for_only_when_its_reading_is_due():
    never: Future = Future()

    class Stuck:
        period, latency = 1.0, 0.5

        def sample(self, stamp, model, data):
            return never

    suite = SensorSuite([Stuck()])
    suite.sample(0.0, None, None)
    assert suite.arrived(0.4) == ()
    never.set_result(ImuReading(0.0, np.zeros(3), np.zeros(3)))
    assert len(suite.arrived(0.5)) == 1
