"""The machine as built: deviations from the drawing, drawn by seed from tolerances.

The stack never sees these. Mount tolerances are what is left after the maker's own calibration:
a camera to tenths of a millimetre and half a milliradian, as eye-in-hand calibration leaves it
(Tsai & Lenz 1989 report errors of that order); brackets that are only bolted on to 2 mm. All are
class figures for a machine of this kind, chosen, not measured.
"""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array, rot_x, rot_y, rot_z, transform

WHEEL_RADIUS = 0.00008  # m, 1 sigma: ground rollers, 0.1 mm class
HALF_TRACK = 0.0005  # m, 1 sigma: welded frame
CAMERA_POSITION, CAMERA_ANGLE = 0.0003, 0.0005  # m, rad: after hand-eye calibration
# Relative, of all cameras: after intrinsic calibration. Zhang 2000, Table 1, leaves 0.17 % of the
# focal length and 0.7 px of the principal point at 640 columns from five pictures; a maker's forty
# leave a third of that.
CAMERA_FOCAL = 0.0005
CAMERA_CENTRE = 0.25 / 640  # of the picture's width, 1 sigma along u and v
CAMERA_WIDTH, RGBD_WIDTH, TAG_CAMERA_WIDTH = 640, 424, 320  # px
TAG_CAMERA_POSITION, TAG_CAMERA_ANGLE = 0.0005, 0.001  # m, rad: after extrinsic calibration
MOUNT_POSITION, MOUNT_ANGLE = 0.002, 0.003  # m, rad: lidar, depth camera, scanning head bolted on
BEACON_PLANES = 0.003  # rad, 1 sigma: line lasers glued into their seats; guess
ARM_JOINT_ZERO = 0.0003  # rad: after arm calibration


@dataclass(frozen=True)
class AsBuilt:
    """One vehicle off the line. `*_mount` maps the true sensor frame to its drawn frame."""

    wheel_radius: Array  # (4,) m, added to the drawing
    half_track: float  # m, added
    camera_mount: Array  # (4, 4)
    camera_focal: float  # factor
    rgbd_mount: Array  # (4, 4)
    lidar_mount: Array  # (4, 4)
    arm_joint_zero: Array  # (2, 6) rad: encoder reads true angle plus this
    dock: Array  # (3,) x, y, yaw added to the drawn dock pose
    tag_camera_mount: Array  # (4, 4)
    floor_seed: int  # of how the floor tags are stuck down and walls and machines set up
    rgbd_focal: float  # factor
    rgbd_centre: Array  # (2,) px, u and v of the principal point off the picture's middle
    tag_camera_focal: float  # factor
    tag_camera_centre: Array  # (2,) px
    beacon_mount: Array  # (4, 4)
    beacon_planes: Array  # (3,) rad, added to phi_1, phi_2, phi_r of the scanning head
    camera_centre: Array  # (2,) px

    @classmethod
    def draw(cls, rng: np.random.Generator, tolerances) -> "AsBuilt":
        """Draw one vehicle. `tolerances` is the layout's `world.tolerances`."""
        k = tolerances.scale

        def mount(position: float, angle: float) -> Array:
            a, p = rng.normal(0, k * angle, 3), rng.normal(0, k * position, 3)
            return transform(rot_z(a[2]) @ rot_y(a[1]) @ rot_x(a[0]), p)

        return cls(
            wheel_radius=rng.normal(0, k * WHEEL_RADIUS, 4),
            half_track=float(rng.normal(0, k * HALF_TRACK)),
            camera_mount=mount(CAMERA_POSITION, CAMERA_ANGLE),
            camera_focal=float(1 + rng.normal(0, k * CAMERA_FOCAL)),
            rgbd_mount=mount(MOUNT_POSITION, MOUNT_ANGLE),
            lidar_mount=mount(MOUNT_POSITION, MOUNT_ANGLE),
            arm_joint_zero=rng.normal(0, k * ARM_JOINT_ZERO, (2, 6)),
            dock=np.array(
                [
                    *rng.uniform(-tolerances.dock_xy, tolerances.dock_xy, 2),
                    np.radians(rng.uniform(-tolerances.dock_yaw_deg, tolerances.dock_yaw_deg)),
                ]
            ),
            tag_camera_mount=mount(TAG_CAMERA_POSITION, TAG_CAMERA_ANGLE),
            floor_seed=int(rng.integers(1 << 32)),
            beacon_mount=mount(MOUNT_POSITION, MOUNT_ANGLE),
            beacon_planes=rng.normal(0, k * BEACON_PLANES, 3),
            rgbd_focal=float(1 + rng.normal(0, k * CAMERA_FOCAL)),
            rgbd_centre=rng.normal(0, k * CAMERA_CENTRE * RGBD_WIDTH, 2),
            tag_camera_focal=float(1 + rng.normal(0, k * CAMERA_FOCAL)),
            tag_camera_centre=rng.normal(0, k * CAMERA_CENTRE * TAG_CAMERA_WIDTH, 2),
            camera_centre=rng.normal(0, k * CAMERA_CENTRE * CAMERA_WIDTH, 2),
        )
