"""The one loop: plant and stack in lockstep, simulated time the only clock.

Each physics step of 2 ms the control unit turns encoder counts into PWM; every fifth step the
readings that have arrived go to the stack and its commands to the drives.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from twin.messages import BodyVelocity, Commands, Reading, StackState, WheelState
from twin.plant.plant import STEPS_PER_TICK, Plant
from twin.plant.world import Truth
from twin.stack.control_unit import ControlUnit
from twin.stack.stack import Stack


@dataclass(frozen=True)
class Tick:
    """What happened in one tick of 10 ms, for those who watch."""

    stamp: float
    readings: tuple[Reading, ...]
    commands: Commands
    state: StackState
    truth: Truth


class Observer(Protocol):
    """Watches the run; nothing flows back."""

    def observe(self, tick: Tick) -> None: ...


class Loop:
    """Closes the loop between a plant and a stack.

    Args:
        plant: the simulated cell.
        stack: the stack under test.
        unit: the vehicle's control unit.
        observers: called after every tick, in order.
    """

    def __init__(self, plant: Plant, stack: Stack, unit: ControlUnit, observers=()):
        self.plant, self.stack, self.unit = plant, stack, unit
        self.observers: tuple[Observer, ...] = tuple(observers)
        self.busy_s = 0.0  # wall time in the loop, observers left out
        self._body_velocity = BodyVelocity()
        self._wheel_state: WheelState | None = None

    def tick(self) -> Tick:
        """Advance by one tick of the stack (10 ms)."""
        start = time.perf_counter()
        stamp, truth = self.plant.time, self.plant.truth()
        readings = self.plant.readings()
        if self._wheel_state is not None:
            readings = (self._wheel_state, *readings)
        commands = self.stack.step(stamp, readings)
        self.plant.apply(commands)
        self._body_velocity = commands.body_velocity
        for _ in range(STEPS_PER_TICK):
            pwm, self._wheel_state = self.unit.step(
                self.plant.encoder_counts(), self._body_velocity
            )
            self.plant.step(pwm)
        self.busy_s += time.perf_counter() - start
        tick = Tick(stamp, readings, commands, self.stack.state, truth)
        for observer in self.observers:
            observer.observe(tick)
        return tick

    def run(self, duration: float, until: Callable[[Tick], bool] = lambda tick: False) -> bool:
        """Tick until `until` holds (returns True) or `duration` seconds have passed (False)."""
        while self.plant.time < duration - 1e-9:
            if until(self.tick()):
                return True
        return False
