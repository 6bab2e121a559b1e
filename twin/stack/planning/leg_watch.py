"""Whether a straight leg is free: docking and leaving go by no band, but not blindly either.

What the map draws is where the leg was drawn to pass; what stands off the map, and what moves,
stops it.
"""

import math

import numpy as np

from twin.geometry import Array, wrap_angle
from twin.stack.config import DriveLimits
from twin.stack.planning.clearance import Footprint, room

REACTION = 0.3  # s from a scan to the wheels' answer
AHEAD, AHEAD_TURN = 0.15, 0.15  # m, rad beyond what braking takes
INSET = 0.02  # m of the vehicle's rim that may touch: cells are coarse and poses err
STEP, STEP_TURN = 0.03, 0.05  # m, rad between the poses that are checked


def leg_blocked(
    pose: Array,
    goal: Array,
    velocity: Array,
    strangers: Array,
    body: Footprint,
    limits: DriveLimits,
) -> bool:
    """Whether what stands there would be touched before the vehicle could stop.

    Args:
        pose: x, y, yaw in world.
        goal: of the leg, likewise.
        velocity: vx, vy, omega in base.
        strangers: rows as in `clearance`.
        body: of the vehicle.
        limits: of its drives.
    """
    if not len(strangers):
        return False
    change = np.asarray(goal, dtype=float) - pose
    change[2] = wrap_angle(change[2])
    distance, turn = float(np.hypot(*change[:2])), abs(float(change[2]))
    speed, rate = float(np.hypot(*velocity[:2])), abs(float(velocity[2]))
    reach = speed**2 / (2 * limits.acceleration) + REACTION * speed + AHEAD
    reach_turn = rate**2 / (2 * limits.turn_acceleration) + REACTION * rate + AHEAD_TURN
    share = min(reach / max(distance, 1e-9), reach_turn / max(turn, 1e-9), 1.0)
    count = 1 + math.ceil(share * max(distance / STEP, turn / STEP_TURN))
    inner = Footprint(body.length - 2 * INSET, body.width - 2 * INSET)
    places = pose + np.linspace(0.0, share, count)[:, None] * change
    return any(room(place, inner, strangers) < 0.0 for place in places)
