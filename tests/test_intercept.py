"""Properties of grasp timing and belt intercept on random inputs."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from twin.stack.grasping.intercept import (
    arm_start_delay,
    first_feasible,
    intercept,
    time_to_stop,
)

positive = st.floats(0.05, 3.0)
speeds = st.floats(0.05, 0.5)


def driven(distance, speed, cruise, a, dt=1e-4):
    """Time to stop by integrating the profile: as fast as allowed, yet able to stop in time."""
    t, left, v = 0.0, distance, speed
    while left > 1e-4 and t < 200:
        v = min(v + a * dt, cruise, np.sqrt(2 * a * left))
        left -= v * dt
        t += dt
    return t


@given(st.floats(0.3, 2.0), st.floats(0.0, 0.4), st.floats(0.4, 1.0), st.floats(0.4, 2.0))
def test_time_to_stop_is_that_of_the_driven_profile(distance, speed, cruise, a):
    assume(distance > speed * speed / (2 * a))
    expected = driven(distance, speed, cruise, a, 1e-3)
    assert time_to_stop(distance, speed, a, cruise) == pytest.approx(expected, abs=0.05)


@given(positive, positive, positive, st.floats(0.0, 2.0))
def test_arms_start_so_that_they_are_ready_when_the_vehicle_stands(distance, v, a, preparation):
    delay = arm_start_delay(distance, v, a, preparation)
    assert delay + preparation == pytest.approx(time_to_stop(distance, v, a))
    # A longer way never lets them start earlier, a longer preparation never later.
    assert arm_start_delay(distance + 0.1, v, a, preparation) >= delay - 1e-9
    assert arm_start_delay(distance, v, a, preparation + 0.1) <= delay


@given(positive, positive)
def test_time_to_stop_is_continuous_where_braking_begins(v, a):
    way = v * v / (2 * a)
    late, early = time_to_stop(way * (1 - 1e-9), v, a), time_to_stop(way * (1 + 1e-9), v, a)
    assert late == pytest.approx(early, rel=1e-3)
    assert late == pytest.approx(v / a, rel=1e-3)


def test_standing_vehicle():
    assert time_to_stop(0.0, 0.0, 0.8) == 0.0
    assert time_to_stop(-0.01, 0.1, 0.8) == 0.0
    assert time_to_stop(1.0, 0.0, 0.8) == float("inf")
    assert time_to_stop(1.0, 0.0, 1.0, cruise=5.0) == pytest.approx(2.0)


def reach(base, slope):
    return lambda x: base + slope * abs(x)


@given(st.floats(-1.5, 1.5), speeds, st.booleans(), st.floats(0.05, 0.6), positive, st.floats(0, 1))
def test_intercept_lies_in_the_window_and_in_time(x, speed, backward, width, base, slope):
    v = -speed if backward else speed
    ready = reach(base, slope)
    found = intercept(3.0, x, v, (-0.1, -0.1 + width), ready)
    if found is None:
        return
    assert -0.1 <= found.x <= -0.1 + width
    assert found.x == pytest.approx(x + v * (found.time - 3.0), abs=1e-9)
    assert found.time - 3.0 >= ready(found.x) - 1e-6


@given(
    st.floats(-1.5, 1.5), speeds, st.floats(0.05, 0.6), positive, st.floats(0, 1), st.floats(0, 1)
)
def test_later_readiness_never_gives_an_earlier_intercept(x, v, width, base, slope, extra):
    window = (0.0, width)
    soon = intercept(0.0, x, v, window, reach(base, slope))
    late = intercept(0.0, x, v, window, reach(base + extra, slope))
    if late is not None:
        assert soon is not None and soon.time <= late.time + 1e-9


@given(speeds, st.floats(0.1, 0.6), positive)
def test_intercept_is_found_whenever_there_is_time(v, width, base):
    x = -v * base - 0.05  # reaches the window after the arm is ready
    found = intercept(0.0, x, v, (0.0, width), reach(base, 0.0))
    assert found is not None and found.x == pytest.approx(0.0, abs=1e-9)
    passed = intercept(0.0, width + 0.01, v, (0.0, width), reach(base, 0.0))
    assert passed is None


def test_part_that_lies_still():
    assert intercept(0.0, 0.1, 0.0, (0.0, 0.2), reach(0.7, 0.0)).time == pytest.approx(
        0.7, abs=1e-3
    )
    assert intercept(0.0, 0.3, 0.0, (0.0, 0.2), reach(0.7, 0.0)) is None


@given(st.floats(0, 5), st.floats(0, 5), st.floats(0, 5))
def test_first_feasible_moment(begin, length, root):
    found = first_feasible(lambda t: t - root, begin, begin + length)
    if root > begin + length:
        assert found is None
    else:
        assert found == pytest.approx(max(root, begin), abs=2e-4)
        assert found >= root
