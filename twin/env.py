"""The cell as a dm_env environment, for those who bring a controller of their own.

Actions are what the stack would command, observations what it would be told: the last reading of
each sensor that has arrived, noisy and late. The truth is in `physics` and in what a reward is
given; it is never among the observations.
"""

from collections.abc import Callable

import dm_env
import numpy as np
from dm_env import specs

from twin.layout import Layout, load_layout
from twin.messages import (
    PART_CLASSES,
    ArmCommand,
    ArmReading,
    BodyVelocity,
    CameraFrame,
    Commands,
    GripperCommand,
    GripperReading,
    ImuReading,
    LidarScan,
    Order,
    Reading,
    RgbdFrame,
    WheelState,
)
from twin.plant.physics import physics_of
from twin.plant.plant import STEPS_PER_TICK, Plant
from twin.plant.world import Truth
from twin.stack.config import nominal_config
from twin.stack.control.arm_motion import ArmMotion
from twin.stack.control_unit import ControlUnit

TICK = 0.010  # s between actions
SETTLE = 20  # ticks at the start, after which every sensor has been heard
Observation = dict[str, np.ndarray]


class CellEnv(dm_env.Environment):
    """Vehicle, arms, line and sensors; one step is a tick of 10 ms.

    Action: `body_velocity` (3,) in base, m/s and rad/s; `joint_position` (2, 6), rad;
    `gripper_width` (2,), m. The arms hold themselves against gravity by their own drawing.

    Args:
        layout: what stands where; the default cell without one.
        seed: of the first episode; each further one takes the next.
        time_limit: of an episode, s.
        reward: of a step, from the truth after it; 0 without one.
    """

    def __init__(
        self,
        layout: Layout | None = None,
        seed: int = 0,
        time_limit: float = 120.0,
        reward: Callable[[Truth], float] = lambda truth: 0.0,
    ):
        self.layout = layout or load_layout()
        self.config = nominal_config(self.layout.site, self.layout.options)
        self._seed, self._time_limit, self._reward = seed, time_limit, reward
        self._motions = [ArmMotion(i, self.config) for i in range(2)]
        self._plant: Plant | None = None
        self._seen: Observation = {}
        self._specs = {n: specs.Array(v.shape, v.dtype, n) for n, v in self._begin().items()}
        self._over = True  # a first step begins the first episode

    @property
    def plant(self) -> Plant:
        """The cell of the present episode."""
        assert self._plant is not None
        return self._plant

    # --- dm_env ----------------------------------------------------------------------------------

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode: at the dock, at rest."""
        observation = self._begin()
        self._seed += 1
        return dm_env.restart(observation)

    def step(self, action: Observation) -> dm_env.TimeStep:
        """Act for one tick; after the end of an episode begin the next."""
        if self._over:
            return self.reset()
        self._tick({n: spec.validate(action[n]) for n, spec in self.action_spec().items()})
        reward, truth = self._reward, self.plant.truth()
        self._over = self.plant.time >= self._time_limit - 1e-9
        if self._over:
            return dm_env.truncation(reward(truth), dict(self._seen))
        return dm_env.transition(reward(truth), dict(self._seen))

    def action_spec(self) -> dict[str, specs.BoundedArray]:
        """Limits are the drawing's."""
        drive, arm = self.config.drive, self.config.arm
        most = np.array([drive.speed, drive.speed, drive.turn_rate])
        lower, upper = np.tile(arm.lower, (2, 1)), np.tile(arm.upper, (2, 1))
        return {
            "body_velocity": specs.BoundedArray((3,), float, -most, most, "body_velocity"),
            "joint_position": specs.BoundedArray((2, 6), float, lower, upper, "joint_position"),
            "gripper_width": specs.BoundedArray(
                (2,), float, 0.0, self.config.gripper.stroke, "gripper_width"
            ),
        }

    def observation_spec(self) -> dict[str, specs.Array]:
        """Readings by name; units as in `twin.messages`."""
        return self._specs

    def close(self) -> None:
        """Free the renderer."""
        if self._plant is not None:
            self._plant.close()
            self._plant = None

    # --- the loop --------------------------------------------------------------------------------

    def _begin(self) -> Observation:
        self.close()
        self._plant = Plant(self.layout, self._seed)
        self._plant.park([m.rest for m in self._motions])
        self.physics = physics_of(self._plant.world)
        self._unit, self._seen, self._over = ControlUnit(self.config.wheels), {}, False
        rest = {
            "body_velocity": np.zeros(3),
            "joint_position": np.array([m.rest for m in self._motions]),
            "gripper_width": np.full(2, 0.5 * self.config.gripper.stroke),
        }
        for _ in range(SETTLE):
            self._tick(rest)
        return dict(self._seen)

    def _tick(self, action: Observation) -> None:
        still, plant = np.zeros(6), self.plant
        arms = [
            ArmCommand(i, q, still, m.dynamics.torque(q, still, still))
            for i, (m, q) in enumerate(zip(self._motions, action["joint_position"], strict=True))
        ]
        force = self.config.gripper.force
        hands = [GripperCommand(i, float(w), force) for i, w in enumerate(action["gripper_width"])]
        velocity = BodyVelocity(*map(float, action["body_velocity"]))
        plant.apply(Commands(velocity, tuple(arms), tuple(hands), mast_camera=True))
        wheels = None
        for _ in range(STEPS_PER_TICK):
            pwm, wheels = self._unit.step(plant.encoder_counts(), velocity)
            plant.step(pwm)
        assert wheels is not None
        for reading in (wheels, *plant.readings()):
            self._hear(reading)

    def _hear(self, reading: Reading) -> None:
        """Readings of two arms share an array; a new one is made, since the old was handed out."""
        seen = self._seen
        match reading:
            case WheelState():
                seen["wheel_ticks"] = reading.ticks
                seen["wheel_velocity"] = reading.body_velocity
            case ImuReading():
                seen["accel"], seen["gyro"] = reading.accel, reading.gyro
            case LidarScan():
                seen["lidar"] = reading.ranges
            case RgbdFrame():
                seen["rgb"], seen["depth_mm"] = reading.rgb, reading.depth_mm
            case CameraFrame():
                seen["mast_camera"] = reading.image
            case ArmReading():
                self._put("joint_position", reading.arm, reading.position)
                self._put("joint_velocity", reading.arm, reading.velocity)
            case GripperReading():
                self._put("gripper_width", reading.arm, reading.width)
                self._put("gripper_force", reading.arm, reading.force)
            case Order():
                wanted = dict(reading.items)
                seen["order"] = np.array([wanted.get(c, 0) for c in PART_CLASSES])

    def _put(self, name: str, arm: int, value) -> None:
        both = self._seen.get(name, np.zeros((2, *np.shape(value)))).copy()
        both[arm] = value
        self._seen[name] = both
