"""The world under dm_control's hood: named access and rendering of the same state."""

from dm_control import mujoco as dm_mujoco
from dm_control.mujoco import wrapper

from twin.plant.world import World


def physics_of(world: World) -> dm_mujoco.Physics:
    """dm_control's `Physics` of a world. Both see one state from now on; step the world only."""
    physics = dm_mujoco.Physics.from_model(wrapper.MjModel(world.model))
    world.move_to(physics.data.ptr)
    return physics
