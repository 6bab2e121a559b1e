"""A run for the rerun viewer: what is true, what the stack believes, what the sensors see."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import rerun as rr

from twin.floor_plan import FOOTPRINT
from twin.geometry import pose2_to_transform, wrap_angle
from twin.messages import (
    CameraFrame,
    FloorFrame,
    GripperReading,
    LidarScan,
    RgbdFrame,
    StackState,
)
from twin.recording.beacon_view import BeaconView
from twin.recording.blueprint import blueprint
from twin.recording.columns import Columns
from twin.recording.scene import body_entities, draw
from twin.stack.config import Camera, StackConfig

if TYPE_CHECKING:  # the loop brings the plant with it, which a reader of recordings may not have
    from twin.loop import Tick
    from twin.plant.world import World

POSE_PERIOD = 0.05  # s
PATH_PERIOD = 0.2  # s
FLUSH_PERIOD = 2.0  # s
JPEG_QUALITY = 80
COLOURS = {
    "true": (60, 180, 75),
    "estimate": (0, 130, 200),
    "fused": (145, 30, 180),
    "wheels": (230, 120, 30),
}


class ViewerLog:
    """Writes an .rrd as the run goes on; what is there can be read whenever the run breaks off.

    Args:
        path: file to write.
        world: the cell, for its shapes and where they are.
        config: what the stack was told of vehicle and site.
        counts: called at every plotted moment; numbers by name, plotted as picks/<name>.
    """

    def __init__(
        self,
        path: Path,
        world: "World",
        config: StackConfig,
        counts: Callable[[], Mapping[str, float]] = dict,
    ):
        self._world, self._counts = world, counts
        self._out = rr.RecordingStream("twin")
        self._out.save(path, default_blueprint=blueprint(config.site))
        self._columns = Columns(self._out)
        self._entities = body_entities(world.shapes)
        self._bodies = np.array(list(self._entities))
        self._shown = np.full((len(self._bodies), 7), np.nan)  # poses last logged
        self._next = {"pose": 0.0, "path": 0.0, "flush": 0.0}
        self._path: dict[str, np.ndarray] = {}
        self._detected = -1.0
        self._beacons = BeaconView(self._out, config)
        self._draw(config)

    def observe(self, tick: "Tick") -> None:
        """Log a tick."""
        t, state = tick.stamp, tick.state
        for reading in tick.readings:
            self._sensor(reading)
        if state.detections_stamp > self._detected:
            self._detected = state.detections_stamp
            self._detections(state)
        for line in state.events:
            self.event(t, line)
        for sight in state.sights:
            self.event(sight.stamp, f"tag {sight.tag}: {sight.action}")
        for sight in state.beacons:
            self._beacons.draw(sight)
            for name, value in self._beacons.sigma(sight).items():
                self.plot(sight.stamp, name, value)
        if self._due("pose", t, POSE_PERIOD):
            self._poses(tick)
        if self._due("path", t, PATH_PERIOD):
            self._paths(tick)
            self._navigation(t, state)
        if self._due("flush", t, FLUSH_PERIOD):
            self._columns.send()

    def event(self, stamp: float, text: str, level: str = "INFO") -> None:
        """One line for the list of events."""
        self._at(stamp)
        self._out.log("events", rr.TextLog(text, level=level))

    def plot(self, stamp: float, name: str, value: float) -> None:
        """A value over time; `name` is picks/..., errors/..., drive/..., ..."""
        self._columns.scalar(name, stamp, value)

    def metrics(self, markdown: str) -> None:
        """The run's outcome, as a page."""
        document = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
        self._out.log("metrics", document, static=True)

    def close(self) -> None:
        """Write what is left and close the file."""
        self._columns.send()
        self._out.flush()
        self._out.disconnect()

    # --- once ----------------------------------------------------------------------------------

    def _draw(self, config: StackConfig) -> None:
        self._out.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        draw(self._out, self._world.shapes)
        box = rr.Boxes3D(
            half_sizes=[(FOOTPRINT[0] / 2, FOOTPRINT[1] / 2, 0.005)], colors=[0, 130, 200]
        )
        self._out.log("world/estimate/footprint", box, static=True)
        cameras = {
            "mast_camera": config.camera,
            "rgbd": config.rgbd,
            "floor_camera": config.tag_camera,
        }
        for name, camera in cameras.items():
            self._place(f"world/estimate/{name}", camera.T_base_camera)
        self._pinhole("world/estimate/mast_camera", config.camera)
        self._pinhole("world/estimate/floor_camera", config.tag_camera)
        self._pinhole("world/estimate/rgbd/colour", config.rgbd)
        self._pinhole("world/estimate/rgbd/depth", config.rgbd, scale=0.5)
        self._place("world/estimate/lidar", config.T_base_lidar)
        tags = config.site.tags
        points = rr.Points3D(
            [(*tag.pose[:2], 0.0) for tag in tags],
            labels=[tag.name for tag in tags],
            radii=0.05,
            colors=(255, 225, 25),
        )
        self._out.log("world/tags", points, static=True)
        for name, colour in COLOURS.items():
            style = rr.LineStrips3D.from_fields(colors=[colour], radii=[0.012])
            self._out.log(f"world/paths/{name}", style, static=True)

    def _place(self, entity: str, T_parent_child) -> None:
        placed = rr.Transform3D(translation=T_parent_child[:3, 3], mat3x3=T_parent_child[:3, :3])
        self._out.log(entity, placed, static=True)

    def _pinhole(self, entity: str, camera: Camera, scale: float = 1.0) -> None:
        pinhole = rr.Pinhole(
            image_from_camera=np.diag([scale, scale, 1.0]) @ camera.matrix,
            resolution=[scale * camera.width, scale * camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.12,
        )
        self._out.log(entity, pinhole, static=True)

    # --- every now and then ---------------------------------------------------------------------

    def _poses(self, tick: "Tick") -> None:
        position, quat = self._world.body_poses()
        poses = np.column_stack([position, quat])[self._bodies]
        moved = ~(np.abs(poses - self._shown).max(axis=1) < 1e-4)
        for body, pose in zip(self._bodies[moved], poses[moved], strict=True):
            # Where the bodies are now: the tick's stamp is from before its physics steps.
            self._columns.pose(self._entities[int(body)], self._world.time, pose)
        self._shown[moved] = poses[moved]

        t, state, true = tick.stamp, tick.state, np.asarray(tick.truth.pose)
        T = pose2_to_transform(state.pose)
        half = state.pose[2] / 2
        quat_wxyz = (np.cos(half), 0.0, 0.0, np.sin(half))
        self._columns.pose("world/estimate", t, np.array([*T[:3, 3], *quat_wxyz]))
        estimates = {
            "estimate": state.pose,
            "fused": state.fused_pose,
            "wheels": state.odometry_pose,
        }
        for name, pose in estimates.items():
            distance = 1e3 * float(np.hypot(*(pose[:2] - true[:2])))
            yaw = float(np.degrees(wrap_angle(pose[2] - true[2])))
            self.plot(t, f"errors/{name}_position_mm", distance)
            self.plot(t, f"errors/{name}_yaw_deg", yaw)
        for i, name in enumerate(("vx", "vy", "omega")):
            self.plot(t, f"drive/{name}", float(tick.truth.velocity[i]))
            self.plot(t, f"drive/{name}_wanted", tick.commands.body_velocity.as_array()[i])
        if np.isfinite(state.distance_to_pick):
            self.plot(t, "drive/distance_to_pick", state.distance_to_pick)
        self.plot(t, "localisation/particles", float(state.particles))
        self.plot(t, "localisation/lost", float(state.lost))
        for name, value in state.goals.items():
            self.plot(t, f"goals/{name}", value)
        for name, value in self._counts().items():
            self.plot(t, f"picks/{name}", value)
        self._tracks(t, state)

    def _tracks(self, t: float, state: StackState) -> None:
        self._at(t)
        labels = [f"{p.track_id} {p.part_class}" for p in state.tracks]
        points = np.array([p.p_odom for p in state.tracks]).reshape(-1, 3)
        shown = rr.Points3D(points, labels=labels, radii=0.006, colors=(240, 50, 230))
        self._out.log("world/tracks", shown)

    def _paths(self, tick: "Tick") -> None:
        now = {
            "true": tick.truth.pose,
            "estimate": tick.state.pose,
            "fused": tick.state.fused_pose,
            "wheels": tick.state.odometry_pose,
        }
        for level, (name, pose) in enumerate(now.items()):
            point = np.array([pose[0], pose[1], 0.01 * (4 - level)])
            if name in self._path:
                self._columns.line(f"world/paths/{name}", tick.stamp, [self._path[name], point])
            self._path[name] = point

    def _navigation(self, t: float, state: StackState) -> None:
        """The global way and the piece of it that is driven now."""
        self._at(t)
        ways = (
            ("path", state.navigation.path, (128, 128, 128), 0.06),
            ("trajectory", state.navigation.trajectory, (240, 50, 230), 0.08),
        )
        for name, way, colour, height in ways:
            points = np.column_stack([way[:, :2], np.full(len(way), height)])
            shown = rr.LineStrips3D([points] if len(way) > 1 else [], colors=colour, radii=0.01)
            self._out.log(f"world/navigation/{name}", shown)

    # --- sensors --------------------------------------------------------------------------------

    def _sensor(self, reading) -> None:
        """Log a reading at its exposure."""
        if isinstance(reading, CameraFrame):
            self._at(reading.stamp)
            self._out.log("world/estimate/mast_camera", _jpeg(reading.image))
        elif isinstance(reading, FloorFrame):
            self._at(reading.stamp)
            self._out.log("world/estimate/floor_camera", _jpeg(reading.image))
        elif isinstance(reading, RgbdFrame):
            self._at(reading.stamp)
            self._out.log("world/estimate/rgbd/colour", _jpeg(reading.rgb))
            png = cv2.imencode(".png", np.ascontiguousarray(reading.depth_mm[::2, ::2]))[1]
            depth = rr.EncodedDepthImage(png.tobytes(), media_type="image/png", meter=1000.0)
            self._out.log("world/estimate/rgbd/depth", depth)
        elif isinstance(reading, LidarScan):
            self._lidar(reading)
        elif isinstance(reading, GripperReading):
            name = f"grippers/arm{reading.arm}"
            self.plot(reading.stamp, f"{name}_width_mm", 1e3 * reading.width)
            self.plot(reading.stamp, f"{name}_force_n", reading.force)

    def _lidar(self, scan: LidarScan) -> None:
        angle = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
        hit = np.isfinite(scan.ranges)
        r, a = scan.ranges[hit], angle[hit]
        points = np.column_stack([r * np.cos(a), r * np.sin(a), np.zeros(len(r))])
        self._at(scan.stamp)
        self._out.log(
            "world/estimate/lidar", rr.Points3D(points, radii=0.012, colors=(230, 25, 75))
        )

    def _detections(self, state: StackState) -> None:
        self._at(state.detections_stamp)
        outlines = [np.vstack([d.contour_px, d.contour_px[:1]]) for d in state.detections]
        labels = [f"{d.part_class} {d.confidence:.2f}" for d in state.detections]
        shown = rr.LineStrips2D(outlines, labels=labels, colors=(60, 255, 60), radii=1.0)
        self._out.log("world/estimate/mast_camera/detections", shown)

    def _at(self, stamp: float) -> None:
        self._out.set_time("sim", duration=stamp)

    def _due(self, what: str, t: float, period: float) -> bool:
        if t < self._next[what] - 1e-6:
            return False
        self._next[what] = t + period
        return True


def _jpeg(picture) -> rr.EncodedImage:
    """A colour (RGB) or grey picture."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    bgr = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    data = cv2.imencode(".jpg", bgr, quality)[1]
    return rr.EncodedImage(contents=data.tobytes(), media_type="image/jpeg")
