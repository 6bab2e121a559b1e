"""The vehicle draws a map of cell, goods-in and warehouse while it drives past everything.

Li & An 2025, section 2.1, and Xu et al. It calibrates its depth camera, whose drawing is wrong, by
turning between walls and two sloping boards; then drives through all aisles, corrected by nothing
but its own map and the surveyed walls. Half of the obstacles are of kinds that the lidar misses, a
sixth stand where the depth camera never comes near. The maps of both sensors and the fused one are
scored against what was truly visible from the path; so is the fused map of a mapper without the
surveyed walls.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from evaluation.ape import pose_errors
from evaluation.belief import belief
from evaluation.map_truth import map_truth
from evaluation.maps import map_metrics, score, write_pictures
from evaluation.places import check_places
from evaluation.run import Criterion, RunRequest, RunResult, Trajectory
from evaluation.simulation import Simulation
from twin.geometry import Array, compose2, inverse, rot_z, transform
from twin.layout import Layout, Obstacle
from twin.loop import Tick
from twin.messages import Goal, LidarScan, MapOrder, RgbdFrame
from twin.plant.plant import Plant
from twin.stack.config import StackConfig, nominal_config
from twin.stack.estimation.extrinsic_calibration import rotation_exp
from twin.stack.estimation.mapper import Mapper, MapperSettings
from twin.stack.estimation.occupancy_grid import OCCUPIED
from twin.stack.estimation.vehicle_calibration import Calibration, save_calibration

LONGEST = 420.0  # s of simulated time after which the run is given up
WRONG_SHIFT, WRONG_TURN = 0.030, np.radians(2.0)  # by which the camera's drawing is wrong
EAST, NORTH, WEST, SOUTH = 0.0, np.pi / 2, np.pi, -np.pi / 2
NORTH_EAST, NORTH_WEST = np.pi / 4, 3 * np.pi / 4
# Past everything: west of the belt, through the door to goods-in, then aisle by aisle from north
# to south, each by way of its middle, or obstacles in it might send the vehicle round by the next;
# the cross aisle W is met again at each. Before an aisle it looks at the shelves on both sides of
# its mouth: turning on the way, it would pass their first metre unseen.
ROUTE = (
    ("belt west", (2.4, 1.6, NORTH)),
    ("belt north-west", (2.4, 4.5, NORTH)),
    ("door", (3.55, 6.2, NORTH)),
    ("G0", (5.2, 6.9, EAST)),
    ("W4", (7.35, 7.45, EAST)),
    ("W3", (7.10, 5.75, SOUTH)),
    ("W3 north-east", (7.10, 5.75, NORTH_EAST)),
    ("W3 east", (7.10, 5.75, EAST)),
    ("M3", (11.0, 5.75, EAST)),
    ("M4 west", (11.0, 7.4, WEST)),
    ("M4 east", (11.0, 7.4, EAST)),
    ("E3", (14.55, 5.75, EAST)),
    ("E3 north", (14.55, 5.9, NORTH)),
    ("E2", (14.65, 3.65, SOUTH)),
    ("E2 north-west", (14.65, 3.65, NORTH_WEST)),
    ("E2 west", (14.65, 3.65, WEST)),
    ("M2", (11.0, 3.65, WEST)),
    ("W2", (7.35, 3.65, WEST)),
    ("W1", (7.10, 1.55, SOUTH)),
    ("W1 north-east", (7.10, 1.55, NORTH_EAST)),
    ("W1 east", (7.10, 1.55, EAST)),
    ("M1", (11.0, 1.55, EAST)),
    ("E1", (14.55, 1.55, EAST)),
    ("E0", (14.65, -0.65, SOUTH)),
    ("E0 north-west", (14.65, -0.65, NORTH_WEST)),
    ("E0 west", (14.65, -0.65, WEST)),
    ("M0", (11.0, -0.65, WEST)),
    ("W0", (7.35, -0.65, WEST)),
    ("C0", (5.65, -0.65, WEST)),
    ("L0", (4.4, 0.3, NORTH)),
    ("belt east", (4.5, 2.6, NORTH)),
    ("belt north-east", (4.7, 4.5, NORTH)),
    ("corner", (5.4, 4.3, SOUTH)),
)
# Places beside the route for things of any size, for flat and small ones, and places that the
# depth camera never comes near.
WIDE = (
    (0.2, 2.6, 0.3),
    (1.0, 4.4, -0.4),
    (5.95, 3.4, NORTH),
    (2.6, -1.05, EAST),
    (4.4, -1.1, EAST),
    (6.2, 6.1, EAST),
)
NARROW = (
    (8.6, -1.25, EAST),
    (10.4, -1.25, EAST),
    (12.6, -1.25, EAST),
    (15.0, 0.6, NORTH),
    (15.0, 2.7, NORTH),
    (15.0, 4.7, NORTH),
    (6.75, 2.3, NORTH),
    (6.75, 4.3, NORTH),
)
FAR = ((-0.5, 7.4, 0.4), (-0.2, 6.2, 0.0), (0.5, 7.0, 0.8))
# Boards that lean back by 45 degrees, near and far from where the vehicle turns to calibrate.
BOARD, BOARDS = "calibration_board", ((1.2, -1.24, 0.0), (1.35, 2.3, np.pi))
LIDAR_MISSES = ("low_box", "table", "black_panel", "glass_panel")
BOTH_SEE = ("carton", "pillar")

CRITERIA = [
    Criterion("occupied_recall_fused", ">=", 0.95),
    Criterion("occupied_recall_gain", ">=", 0.25),
    Criterion("occupied_precision_fused", ">=", 0.90),
    Criterion("calibration_error_mm", "<=", 5.0),
    Criterion("calibration_error_deg", "<=", 0.2),
    Criterion("collisions", "==", 0.0),
]


def run(request: RunRequest, layout: Layout) -> RunResult:
    """One run along the whole route.

    Raises:
        LayoutError: the drawing has something where the route or an obstacle is.
    """
    check_places("mapping", layout.site, ROUTE)
    rng = np.random.default_rng([request.seed, 3])
    layout = with_obstacles(layout, rng)
    config = with_wrong_camera(belief(layout), rng)
    order = MapOrder(0.0, tuple(Goal(name, pose) for name, pose in ROUTE))
    free = FreeMapper(config)
    with Simulation(request, layout, order, (free,), config) as sim:
        free.odometry = sim.stack.localiser.fused.history.at
        free.calibration = lambda: sim.stack.mapper and sim.stack.mapper.calibration

        def over(tick: Tick) -> bool:
            return sim.stack.done

        complete = sim.run(LONGEST, over)
        figures, notes = metrics(sim, layout, request, free), events(sim)
        return sim.result(figures, CRITERIA, complete, notes)


def with_obstacles(layout: Layout, rng: np.random.Generator) -> Layout:
    """Twelve obstacles beside the route; the lidar misses six by their kind, the camera two.

    Of the kinds that the lidar misses each stands there once, two of them twice. Besides, two
    calibration boards.
    """
    wide, narrow, far = (
        [places[i] for i in rng.permutation(len(places))] for places in (WIDE, NARROW, FAR)
    )
    missed = [*LIDAR_MISSES, *(LIDAR_MISSES[i] for i in rng.permutation(4)[:2])]
    # a table fits into wide places alone
    placed = [(kind, (wide if kind == "table" else narrow).pop()) for kind in missed]
    placed += [(str(rng.choice(BOTH_SEE)), places.pop()) for places in (wide, narrow) * 2]
    placed += [(kind, far.pop()) for kind in BOTH_SEE]
    obstacles = tuple(
        Obstacle(kind=kind, pose=(x, y, yaw))  # type: ignore[arg-type]
        for kind, (x, y, yaw) in [*placed, *((BOARD, board) for board in BOARDS)]
    )
    faults = layout.world.faults
    faults = faults.model_copy(update={"obstacles": (*faults.obstacles, *obstacles)})
    world = layout.world.model_copy(update={"faults": faults})
    return layout.model_copy(update={"world": world})


def with_wrong_camera(config: StackConfig, rng: np.random.Generator) -> StackConfig:
    """The belief with the depth camera drawn where it is not: 30 mm and 2 degrees off."""
    shift, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    off = transform(rotation_exp(WRONG_TURN * axis), WRONG_SHIFT * shift)
    T = config.rgbd.T_base_camera
    return replace(config, rgbd=replace(config.rgbd, T_base_camera=T @ off))


class FreeMapper:
    """A second mapper beside the stack's, without the surveyed walls: for comparison alone.

    It hears the same scans and depth pictures, and gets the stack's calibration when the stack has
    it, so that the walls are all that differs.
    """

    def __init__(self, config: StackConfig):
        self.mapper = Mapper(config, settings=MapperSettings(surveyed=False))
        self.odometry: Callable[[float], Array | None] = lambda stamp: None
        self.calibration: Callable[[], Calibration | None] = lambda: None
        self._stamps: list[float] = []
        self._poses: list[Array] = []

    def observe(self, tick: Tick) -> None:
        found = self.calibration()
        if found is not None and not self.mapper.calibrated:
            self.mapper.adopt(found)
        for reading in tick.readings:
            if isinstance(reading, LidarScan | RgbdFrame):
                self.mapper.hear(reading, self.odometry(reading.stamp))
        self._stamps.append(tick.stamp)
        self._poses.append(compose2(self.mapper.world_from_odom, tick.state.fused_pose))

    def path(self) -> Trajectory:
        """Stamps (n,) and poses (n, 3) in world."""
        return np.array(self._stamps), np.array(self._poses).reshape(-1, 3)


def metrics(
    sim: Simulation, layout: Layout, request: RunRequest, free: FreeMapper
) -> dict[str, float]:
    """All figures of the report; maps, calibration and pictures go into the run's folder."""
    tracks, mapper = sim.paths.trajectories(), sim.stack.mapper
    figures: dict[str, float] = {}
    if mapper is not None:
        grids = mapper.grids()
        path, lidar = np.asarray(tracks["truth"][1]), grids["lidar"]
        truth = map_truth(
            sim.plant.world, layout, path, lidar.origin, lidar.resolution, lidar.shape
        )
        states = {name: grid.states() for name, grid in grids.items()}
        figures |= map_metrics(states, truth)
        without = free.mapper.grids()["fused"].states()
        of = score(without == OCCUPIED, truth.surface)
        figures["slam_free_recall"], figures["slam_free_precision"] = of.recall, of.precision
        figures["slam_free_iou"] = of.iou
        mapper.save(request.out)
        write_pictures(request.out, {**states, "free": without}, truth)
        if mapper.calibration is not None:
            save_calibration(mapper.calibration, request.out / "calibration.json")
            figures |= calibration_errors(mapper.calibration, sim.plant, sim.config)
        figures["slam_matched"] = mapper.slam.matched / max(
            mapper.slam.matched + mapper.slam.lost, 1
        )
        figures["slam_loops"] = float(len(mapper.slam.graph.loops))
    slam = pose_errors(tracks["truth"], tracks["estimate"])
    kinds = [o.kind for o in layout.world.faults.obstacles if o.kind != BOARD]
    reached = [outcome == "reached" for _, outcome in sim.stack.state.navigation.outcomes]
    return {
        **figures,
        "obstacles_of_one_sensor_kinds": float(np.mean([k in LIDAR_MISSES for k in kinds])),
        "slam_ape_rmse_m": slam.rmse,
        "slam_ape_max_m": slam.maximum,
        "slam_yaw_rmse_deg": slam.yaw_rmse_deg,
        "slam_free_ape_rmse_m": pose_errors(tracks["truth"], free.path()).rmse,
        "odometry_fused_ape_rmse_m": pose_errors(tracks["truth"], tracks["fused"]).rmse,
        "odometry_ape_rmse_m": pose_errors(tracks["truth"], tracks["odometry"]).rmse,
        "goals_reached": float(np.mean(reached)) if reached else float("nan"),
        "collisions": float(len(sim.plant.world.collisions)),
    }


def calibration_errors(found: Calibration, plant: Plant, config: StackConfig) -> dict[str, float]:
    """Of the depth camera's pose against the lidar as it hangs, by the machine as built.

    `level` is against a level frame at the lidar, at its drawn height above the floor: what upright
    walls and the floor tell, and all that a flat map needs.
    """
    nominal = nominal_config(config.site, config.options)
    T_base_lidar = nominal.T_base_lidar @ plant.as_built.lidar_mount
    T_base_rgbd = nominal.rgbd.T_base_camera @ plant.as_built.rgbd_mount
    x, y, _ = T_base_lidar[:3, 3]
    yaw = np.arctan2(T_base_lidar[1, 0], T_base_lidar[0, 0])
    T_world_base = plant.truth().T_world_base
    heading = np.arctan2(T_world_base[1, 0], T_world_base[0, 0])
    T_level_base = transform(rot_z(heading).T, (0, 0, 0)) @ transform(
        T_world_base[:3, :3], (0.0, 0.0, T_world_base[2, 3])
    )
    T_level_lidar = transform(rot_z(yaw), (x, y, nominal.T_base_lidar[2, 3]))
    level = inverse(T_level_lidar) @ T_level_base @ T_base_rgbd
    figures = {}
    hangs = inverse(T_base_lidar) @ T_base_rgbd
    pairs = ("", found.T_lidar_rgbd, hangs), ("_level", found.T_level_rgbd, level)
    for name, believed, true in pairs:
        shift, turn = apart(believed, true)
        figures[f"calibration{name}_error_mm"] = 1e3 * shift
        figures[f"calibration{name}_error_deg"] = float(np.degrees(turn))
    start = inverse(config.T_base_lidar) @ config.rgbd.T_base_camera
    shift, turn = apart(start, hangs)
    figures["calibration_start_mm"] = 1e3 * shift
    figures["calibration_start_deg"] = float(np.degrees(turn))
    return figures


def apart(a: Array, b: Array) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses. Shapes (4, 4)."""
    R = a[:3, :3].T @ b[:3, :3]
    turn = np.arccos(np.clip((np.trace(R) - 1) / 2, -1.0, 1.0))
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(turn)


def events(sim: Simulation) -> list[str]:
    """What became of the goals, and what was dropped."""
    notes = [f"{name}: {how}" for name, how in sim.stack.state.navigation.outcomes]
    mapper = sim.stack.mapper
    if mapper is not None and mapper.dropped:
        notes.append(f"mapper: {mapper.dropped} readings dropped, the last: {mapper.fault}")
    return notes
