"""The cell as a dm_env environment."""

import dm_env
import numpy as np
import pytest
from dm_env import specs

from twin.env import SETTLE, TICK, CellEnv


def rest(env: CellEnv) -> dict[str, np.ndarray]:
    return {
        "body_velocity": np.zeros(3),
        "joint_position": env.reset().observation["joint_position"],
        "gripper_width": np.full(2, 0.025),
    }


@pytest.fixture
def env():
    env = CellEnv(time_limit=1.5, reward=lambda truth: float(truth.pose[0]))
    yield env
    env.close()


def test_observations_and_actions_are_as_specified(env):
    step = env.reset()
    assert step.first() and step.reward is None
    spec = env.observation_spec()
    assert step.observation.keys() == spec.keys()
    for name, value in step.observation.items():
        spec[name].validate(value)
    assert step.observation["mast_camera"].shape == (480, 640, 3)
    assert step.observation["order"].sum() == 20
    assert all(isinstance(a, specs.BoundedArray) for a in env.action_spec().values())


def test_it_drives_moves_and_ends(env):
    """Expected: the vehicle rolls forward, a joint follows, the hands open, the time runs out."""
    action = rest(env)
    start = action["joint_position"].copy()
    action["body_velocity"][0] = 0.3
    action["joint_position"] = start + [[0.2, 0, 0, 0, 0, 0]] * 2
    action["gripper_width"] = np.array([0.05, 0.03])
    step, steps = env.step(action), 1
    while not step.last():
        step, steps = env.step(action), steps + 1
    assert steps == round(1.5 / TICK) - SETTLE and step.discount == 1.0
    assert step.reward == pytest.approx(env.plant.truth().pose[0]) and step.reward > 0.25
    seen = step.observation
    assert seen["wheel_velocity"][0] == pytest.approx(0.3, abs=0.03)
    np.testing.assert_allclose(seen["joint_position"], action["joint_position"], atol=0.01)
    np.testing.assert_allclose(seen["gripper_width"], [0.05, 0.03], atol=0.001)
    assert env.step(action).first()


def test_same_seed_same_bits():
    def episode(seed: int) -> list[dm_env.TimeStep]:
        env = CellEnv(seed=seed, reward=lambda truth: float(truth.velocity[0]))
        action = rest(env)
        action["body_velocity"][:] = (0.2, -0.1, 0.3)
        try:
            return [env.step(action) for _ in range(20)]
        finally:
            env.close()

    a, b, other = episode(3), episode(3), episode(4)
    for x, y in zip(a, b, strict=True):
        assert x.reward == y.reward
        for name in x.observation:
            np.testing.assert_array_equal(x.observation[name], y.observation[name])
    assert not np.array_equal(a[-1].observation["gyro"], other[-1].observation["gyro"])


def test_what_was_observed_stays(env):
    action = rest(env) | {"body_velocity": np.array([0.5, 0.0, 0.0])}
    first = env.step(action).observation
    kept = {name: value.copy() for name, value in first.items()}
    for _ in range(5):
        env.step(action)
    for name, value in kept.items():
        np.testing.assert_array_equal(first[name], value)


def test_physics_is_the_cell_itself(env):
    action = rest(env) | {"body_velocity": np.array([0.5, 0.0, 0.0])}
    for _ in range(10):
        env.step(action)
    truth = env.plant.truth()
    position = env.physics.named.data.xpos["agv/base"]
    np.testing.assert_array_equal(position, truth.T_world_base[:3, 3])
    assert env.physics.time() == env.plant.time


def test_an_action_out_of_range_is_refused(env):
    action = rest(env) | {"gripper_width": np.array([0.06, 0.0])}
    with pytest.raises(ValueError, match="gripper_width"):
        env.step(action)
