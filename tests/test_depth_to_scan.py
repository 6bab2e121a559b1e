"""Depth pictures of rooms made up by geometry, turned into scans."""

import numpy as np
import pytest
from flat_world import box, cast, floor, picture, upright

from twin.geometry import look_at, rot_x, rot_y, transform
from twin.messages import RgbdFrame
from twin.stack.config import Camera
from twin.stack.estimation.depth_to_scan import DepthNoise, DepthToScan
from twin.stack.estimation.occupancy_grid import OccupancyGrid, SensorModel
from twin.stack.estimation.scans import beam_angles

T_DRAWN = look_at((0.335, 0.0, 0.62), (1.335, 0.0, 0.62))
CAMERA = Camera(424, 240, 58.0, T_DRAWN)
ROOM = box(-2, -1.5, 2.6, 1.5)
FLOOR = floor(-2, -1.5, 2.6, 1.5)
POSE = np.zeros(3)
FAR = DepthNoise(max_range=5.0)


def shelf(x0, x1, y, height, depth=0.02):
    """Front of a board from x0 across y at a height."""
    return (np.array([x0, -y, height]), np.array([0.0, 2 * y, 0.0]), np.array([0.0, 0.0, depth]))


def test_walls_have_the_range_of_plain_geometry():
    """Li & An 2025, Eqs. 3-4: each beam's range is the planar distance in its direction."""
    found = DepthToScan(CAMERA, noise=FAR).convert(
        picture([*upright(ROOM), FLOOR], CAMERA, T_DRAWN, POSE)
    )
    assert found is not None
    np.testing.assert_allclose(found.sensor_pose, (0.335, 0, 0), atol=1e-12)
    expected = cast(ROOM, found.sensor_pose, beam_angles(found.scan))
    assert np.all(np.isfinite(found.scan.ranges))
    assert np.median(np.abs(found.scan.ranges - expected)) < 0.004
    assert np.max(np.abs(found.scan.ranges - expected)) < 0.03


def test_beam_number_by_hand():
    """One upright post dead ahead at 2 m answers in the middle beam with 2 m."""
    post = [(np.array([2.335, -0.02, 0]), np.array([0, 0.04, 0]), np.array([0, 0, 1.0]))]
    found = DepthToScan(CAMERA).convert(picture(post, CAMERA, T_DRAWN, POSE))
    assert found is not None
    hit = np.nonzero(np.isfinite(found.scan.ranges))[0]
    np.testing.assert_allclose(found.scan.ranges[hit], 2.0, atol=2e-3)
    assert np.abs(beam_angles(found.scan)[hit]).max() < 0.011 + found.scan.angle_increment
    assert len(hit) in (3, 4, 5)


@pytest.mark.parametrize(
    ("height", "seen"), [(0.80, True), (0.30, True), (0.10, True), (1.10, False), (0.005, False)]
)
def test_only_the_band_of_the_vehicle_counts(height, seen):
    planes = [shelf(2.0, 2.0, 0.4, height), floor(-2, -3, 9, 3)]
    frame = picture(planes, CAMERA, T_DRAWN, POSE, np.random.default_rng(0), noise=0.003)
    found = DepthToScan(CAMERA).convert(frame)
    assert found is not None
    ahead = np.abs(beam_angles(found.scan)) < 0.15
    ranges = found.scan.ranges[ahead]
    if seen:
        np.testing.assert_allclose(ranges, 1.665 / np.cos(beam_angles(found.scan)[ahead]),
                                   atol=0.03)  # fmt: skip
    else:
        assert not np.any(np.isfinite(ranges))


def test_noise_does_not_raise_the_floor():
    """Bare floor under the noise of the data sheet: no obstacle, and free up to the limit."""
    frame = picture([floor(-9, -9, 9, 9)], CAMERA, T_DRAWN, POSE, np.random.default_rng(1))
    found = DepthToScan(CAMERA).convert(frame)
    assert found is not None
    assert not np.any(np.isfinite(found.scan.ranges))
    assert np.all(found.clear_to > 2.7) and np.all(found.clear_to <= 3.0)


def test_camera_as_calibrated_is_levelled():
    """A camera tilted by 3 degrees and rolled by 2 gives the same walls once that is known."""
    T = T_DRAWN @ transform(rot_x(-0.05) @ rot_y(0.04), (0.0, 0.01, 0.0))
    camera = Camera(424, 240, 58.0, T)
    found = DepthToScan(camera, noise=FAR).convert(
        picture([*upright(ROOM), FLOOR], camera, T, POSE)
    )
    assert found is not None
    expected = cast(ROOM, found.sensor_pose, beam_angles(found.scan))
    error = np.abs(found.scan.ranges - expected)[3:-3]
    assert np.max(error[np.isfinite(error)]) < 0.03 and np.mean(np.isfinite(error)) > 0.98


def test_low_box_is_not_forgotten_as_it_passes_under_the_picture():
    grid = OccupancyGrid.covering((-1, -2), (4, 2), 0.05)
    low = [*upright(box(2.01, -0.2, 2.3, 0.2), top=0.10), floor(-2, -3, 9, 3)]
    convert = DepthToScan(CAMERA)
    model = SensorModel(blind=convert.blind, max_range=3.0)
    assert 0.9 < convert.blind < 1.15
    cell = tuple(grid.cells(np.array([2.02, 0.0])))
    for x in np.arange(0.0, 1.55, 0.1):
        pose = np.array([x, 0.0, 0.0])
        found = convert.convert(picture(low, CAMERA, T_DRAWN, pose))
        assert found is not None
        sensor = pose + found.sensor_pose
        grid.insert_scan(found.scan, sensor, model, found.clear_to)
    assert grid.occupied[cell]
    assert grid.free[tuple(grid.cells(np.array([1.8, 0.0])))]


def test_lone_pixels_are_left_out():
    depth = np.zeros((240, 424), dtype=np.uint16)
    depth[100, 200] = 1500
    found = DepthToScan(CAMERA).convert(RgbdFrame(0.0, np.zeros((240, 424, 3), np.uint8), depth))
    assert found is not None and not np.any(np.isfinite(found.scan.ranges))


@pytest.mark.parametrize(
    ("stamp", "depth", "why"),
    [
        (0.0, np.zeros((240, 424), np.uint16), "no pixel"),
        (0.0, np.ones((120, 424), np.uint16), "wanted"),
        (0.0, np.ones((240, 424), np.float32), "wanted"),
        (np.nan, np.ones((240, 424), np.uint16), "stamp"),
    ],
)
def test_bad_pictures_are_dropped(stamp, depth, why):
    convert = DepthToScan(CAMERA)
    assert convert.convert(RgbdFrame(stamp, np.zeros((*depth.shape, 3), np.uint8), depth)) is None
    assert convert.fault is not None and why in convert.fault and "\n" not in convert.fault
