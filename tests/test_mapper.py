"""The stack's mapper in the drawn hall: walls of plain geometry, a camera that is drawn wrongly."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import floor, picture, scan, upright

from twin.geometry import between2, compose2, inverse, transform, wrap_angle
from twin.layout import load_layout
from twin.messages import RgbdFrame
from twin.stack.config import nominal_config
from twin.stack.estimation.extrinsic_calibration import rotation_exp
from twin.stack.estimation.map_file import load_map
from twin.stack.estimation.mapper import Mapper, MapperSettings, outer_walls
from twin.stack.estimation.occupancy_grid import OCCUPIED
from twin.stack.estimation.vehicle_calibration import (
    Calibration,
    CalibrationRun,
    load_calibration,
    save_calibration,
)

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
WALLS = outer_walls(LAYOUT.site).reshape(-1, 2, 2)
BOX = np.array([[(2.6, 0.3), (2.6, 0.9)], [(2.6, 0.9), (3.2, 0.9)]], dtype=float)
LIDAR = np.array([0.3, 0.0, 0.0])
OFFSET = 0.008  # m that the lidar of these tests reads too far
DRIFT = np.array([0.004, -0.003, 0.002])  # of the odometry in each step


def wrong_camera(config, shift=(0.02, -0.015, 0.015), turn=(0.01, 0.02, -0.02)):
    """The belief with the camera drawn elsewhere."""
    T = config.rgbd.T_base_camera @ transform(rotation_exp(np.array(turn)), shift)
    return replace(config, rgbd=replace(config.rgbd, T_base_camera=T))


def turn_on_the_spot(n=24, start=(1.2, 0.0, 0.0)):
    return [np.array([start[0], start[1], wrap_angle(2 * np.pi * k / n)]) for k in range(n + 1)]


def drive(poses, seed=0, low=None, offset=OFFSET):
    """Readings and drifting odometry along poses: scan, then picture, at each."""
    rng, odometry, before = np.random.default_rng(seed), np.zeros(3), poses[0]
    near = WALLS[(WALLS[:, :, 0] < 7).all(axis=1) | (WALLS[:, 0, 1] == WALLS[:, 1, 1])][:12]
    planes = [*upright(near, 1.1), floor(-1.0, -1.5, 15.2, 8.0), *(low or [])]
    for k, pose in enumerate(poses):
        odometry = compose2(odometry, between2(before, pose))
        if k:
            odometry = odometry + DRIFT * 0.2
        before, stamp = pose, 0.1 * k
        reading = scan(WALLS, compose2(pose, LIDAR), rng, stamp)
        yield replace(reading, ranges=reading.ranges + offset), odometry, pose
        camera = CONFIG.rgbd
        frame = picture(planes, camera, camera.T_base_camera, pose, rng, stamp)
        yield frame, odometry, pose


@pytest.fixture(scope="module")
def turned():
    """A mapper whose camera is drawn wrongly, after a turn on the spot; and what it heard."""
    readings = list(drive(turn_on_the_spot(), low=upright(BOX, 0.12)))
    mapper = Mapper(wrong_camera(CONFIG), start=np.array([1.2, 0.0, 0.0]))
    for reading, odometry, _ in readings:
        assert mapper.hear(reading, odometry)
    return mapper, readings


def test_pose_in_world_is_odometry_through_world_from_odom(turned):
    """Expected result: within 10 mm and 2 mrad, where odometry alone is 30 mm and 10 mrad off."""
    mapper, readings = turned
    _, odometry, true = readings[-1]
    found = compose2(mapper.world_from_odom, odometry)
    assert np.hypot(*(found - true)[:2]) < 0.010
    assert abs(wrap_angle(found[2] - true[2])) < 0.002
    assert mapper.covariance.shape == (3, 3)
    assert np.all(np.linalg.eigvalsh(mapper.covariance) > 0)


def test_camera_is_found_and_its_pictures_wait_for_that(turned):
    """Expected result: 5 mm, 0.2 degrees; a low box is drawn by the camera as found."""
    mapper = Mapper(wrong_camera(CONFIG), start=np.array([1.2, 0.0, 0.0]))
    for reading, odometry, _ in turned[1]:
        assert mapper.hear(reading, odometry)
    assert not mapper.calibrated and not mapper.slam.rgbd.occupied.any()
    assert mapper.calibrate() is None
    found = mapper.belief.rgbd.T_base_camera
    true = CONFIG.rgbd.T_base_camera
    assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.005
    turn = np.arccos(np.clip((np.trace(found[:3, :3].T @ true[:3, :3]) - 1) / 2, -1, 1))
    assert np.degrees(turn) < 0.2
    assert mapper.calibration is not None
    assert mapper.calibration.lidar_range_offset == pytest.approx(OFFSET, abs=0.003)
    front = np.array([(2.6, y) for y in np.linspace(0.4, 0.8, 9)])
    rgbd = mapper.slam.rgbd
    cells = rgbd.cells(front)
    near = [rgbd.occupied[r - 1 : r + 2, c - 1 : c + 2].any() for r, c in cells]
    assert np.mean(near) >= 0.8
    assert not mapper.slam.lidar.occupied[cells[:, 0], cells[:, 1]].any()
    fused = mapper.site_map()
    assert fused.states.shape == rgbd.shape and (fused.states == OCCUPIED).any()


def test_a_calibration_of_before_is_used_at_once(turned):
    _, readings = turned
    T = inverse(CONFIG.T_base_lidar) @ CONFIG.rgbd.T_base_camera
    known = calibration(T)
    mapper = Mapper(wrong_camera(CONFIG), np.array([1.2, 0.0, 0.0]), known)
    found = mapper.belief.rgbd.T_base_camera
    np.testing.assert_allclose(found, CONFIG.rgbd.T_base_camera, atol=1e-12)
    for reading, odometry, _ in readings[:4]:
        mapper.hear(reading, odometry)
    assert mapper.calibrated and np.any(mapper.slam.rgbd.log_odds < 0)


def test_without_walls_the_drawing_is_kept_and_the_reason_said():
    mapper = Mapper(CONFIG)
    assert "0 points on walls" in (mapper.calibrate() or "")
    np.testing.assert_array_equal(mapper.belief.rgbd.T_base_camera, CONFIG.rgbd.T_base_camera)


def test_broken_late_and_repeated_readings_change_nothing(turned):
    mapper, readings = turned
    (last_scan, odometry, _), (last_frame, _, _) = readings[-2:]
    cells = mapper.slam.lidar.log_odds.copy(), mapper.slam.rgbd.log_odds.copy()
    pose, dropped = mapper.slam.pose.copy(), mapper.dropped
    later = last_scan.stamp + 0.1
    bad = [
        (last_scan, odometry),  # twice
        (replace(last_scan, stamp=later), None),
        (replace(last_scan, stamp=later), np.full(3, np.nan)),
        (replace(last_scan, stamp=later, ranges=np.full(1081, np.nan)), odometry),
        (replace(last_scan, stamp=later, ranges=np.zeros(0)), odometry),
        (replace(last_scan, stamp=np.nan), odometry),
        (last_frame, odometry),
        (replace(last_frame, stamp=np.nan), odometry),
        (replace(last_frame, stamp=-5.0), odometry),
    ]
    for reading, odom in bad:
        assert not mapper.hear(reading, odom)
        assert mapper.fault and "\n" not in mapper.fault
    np.testing.assert_array_equal(mapper.slam.pose, pose)
    np.testing.assert_array_equal(mapper.slam.lidar.log_odds, cells[0])
    np.testing.assert_array_equal(mapper.slam.rgbd.log_odds, cells[1])
    assert mapper.dropped == dropped + len(bad)


def test_a_picture_before_any_scan_is_dropped():
    mapper = Mapper(CONFIG)
    frame = RgbdFrame(0.0, np.zeros((1, 1, 3), np.uint8), np.ones((240, 424), np.uint16))
    assert not mapper.hear(frame, np.zeros(3)) and "no scan yet" in (mapper.fault or "")


def test_same_readings_give_the_same_maps(turned, tmp_path):
    _, readings = turned
    for name in ("a", "b"):
        mapper = Mapper(wrong_camera(CONFIG), start=np.array([1.2, 0.0, 0.0]))
        for reading, odometry, _ in readings[:30]:
            mapper.hear(reading, odometry)
        mapper.calibrate()
        (tmp_path / name).mkdir()
        files = mapper.save(tmp_path / name)
    assert len(files) == 6
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    for name, grid in mapper.grids().items():
        loaded = load_map(tmp_path / "b" / f"{name}.yaml", grid.shape)
        np.testing.assert_array_equal(loaded.states(), grid.states())


def test_surveyed_walls_put_a_wrong_start_right():
    """A dock that is 8 mm and 5 mrad off turns the whole map, unless walls are known."""
    true = np.array([1.2, 0.0, 0.0])
    believed = true + np.array([0.006, -0.005, 0.005])
    errors = []
    for surveyed in (True, False):
        mapper = Mapper(CONFIG, believed, settings=MapperSettings(surveyed=surveyed))
        rng = np.random.default_rng(0)
        for k in range(30):
            reading = scan(WALLS, compose2(true, LIDAR), rng, 0.1 * k)
            assert mapper.hear(reading, np.zeros(3))
        errors.append(abs(mapper.slam.pose - true))
    assert np.hypot(*errors[0][:2]) < 0.004 and errors[0][2] < 0.0015
    assert errors[1][2] > 0.004


# --- the calibration's file ---------------------------------------------------------------------


def calibration(T) -> Calibration:
    from twin.stack.estimation.extrinsic_calibration import fixed_angles

    x, y, z = T[:3, 3].tolist()
    return Calibration(
        (x, y, z), fixed_angles(T[:3, :3]), (1e-3,) * 3, (1e-3,) * 3, (0.0,) * 3, 0.002, 0.9, 12, 0
    )


def test_calibration_file_gives_back_what_was_saved(tmp_path):
    T = inverse(CONFIG.T_base_lidar) @ CONFIG.rgbd.T_base_camera
    save_calibration(calibration(T), tmp_path / "c.json")
    loaded = load_calibration(tmp_path / "c.json")
    assert loaded == calibration(T)
    np.testing.assert_allclose(loaded.T_lidar_rgbd, T, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"version": 2', '"version": 9', "version 9, known is 2"),
        ('"pairs": 12', '"pears": 12', "missing or unknown: pairs, pears"),
        ('"residual_rms": 0.9', '"residual_rms": NaN', "residual_rms: wanted 1 finite"),
        ("{", "[", "cannot be read"),
    ],
)
def test_broken_calibration_files_are_refused_in_one_line(tmp_path, old, new, message):
    T = inverse(CONFIG.T_base_lidar) @ CONFIG.rgbd.T_base_camera
    path = tmp_path / "c.json"
    save_calibration(calibration(T), path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as error:
        load_calibration(path)
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match="cannot be read"):
        load_calibration(tmp_path / "none.json")


def test_pairs_are_taken_where_the_vehicle_has_moved(turned):
    _, readings = turned
    run = CalibrationRun(CONFIG)
    for _ in range(5):  # standing: the same view tells nothing new
        for reading, odometry, _ in readings[:2]:
            run.hear(reading, odometry)
    assert run.pairs == 1
    for reading, odometry, _ in readings:
        run.hear(reading, odometry)
    assert run.pairs > 20 and run.turned == pytest.approx(2 * np.pi, abs=0.1)
