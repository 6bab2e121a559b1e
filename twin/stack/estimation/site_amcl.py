"""AMCL on what the stack knows of a site: its drawing, or the maps of an earlier run."""

from pathlib import Path

import numpy as np

from twin.stack.config import StackConfig
from twin.stack.estimation.amcl import Amcl, AmclSettings, MotionModel
from twin.stack.estimation.motion_models import omnidirectional, turn_path_turn
from twin.stack.estimation.site_map import ROOM, floor_map, lidar_map, load_site_map

RANGE_MAX = 30.0  # m, of the lidar: maker's specification
RESOLUTION = 0.025  # m, cells of the drawn map
MAX_DISTANCE = 0.5  # m: farther from the map a beam's end is anywhere; ten sigma of a beam
MOTION: dict[str, MotionModel] = {"omni": omnidirectional, "turn_path_turn": turn_path_turn}


def default_settings(config: StackConfig) -> AmclSettings:
    """The tuning, with the motion model of the options."""
    return AmclSettings(motion=MOTION[config.options.motion_model])


def site_amcl(
    config: StackConfig, rng: np.random.Generator, settings: AmclSettings | None = None
) -> Amcl:
    """A filter that knows the site and not where in it the vehicle is.

    Args:
        config: drawing, mount of the lidar, and options: `map` for a folder of maps.
        rng: for all that the filter draws.
        settings: its tuning; `default_settings` without any.

    Raises:
        ValueError: one line, for a map file that cannot be read or is not of this site.
    """
    if config.options.map is None:
        seen = lidar_map(config.site, config.T_base_lidar, RESOLUTION)
        free = floor_map(config.site, RESOLUTION).room(ROOM)
    else:
        seen = load_site_map(Path(config.options.map) / "lidar.yaml", config.site)
        free = seen.room(ROOM)
    field = seen.likelihood_field(MAX_DISTANCE)
    settings = settings or default_settings(config)
    return Amcl(field, free, config.T_base_lidar, RANGE_MAX, rng, settings)
