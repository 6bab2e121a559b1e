"""Live obstacles over the map: what is kept, what is cleared, and by whom; what moves."""

import numpy as np
import pytest
from flat_world import BEAMS, FIRST, STEP, box, picture, scan

from twin.layout import load_layout
from twin.messages import LidarScan, RgbdFrame
from twin.stack.config import nominal_config
from twin.stack.estimation.moving_objects import MovingObjects, clusters
from twin.stack.estimation.obstacle_layer import ObstacleLayer
from twin.stack.estimation.occupancy_grid import OCCUPIED

LAYOUT = load_layout()
CONFIG = nominal_config(LAYOUT.site, LAYOUT.options)
ROOM = box(-4.0, -3.0, 4.0, 3.0)
HERE = np.zeros(3)
CARTON = box(1.51, -0.2, 1.9, 0.2)
FLOOR = [(-9, -9, 0), (18, 0, 0), (0, 18, 0)]


def layer():
    """A layer over an empty room of 8 x 6 m with walls of a cell."""
    states = np.zeros((130, 170), dtype=np.int8)
    states[:5], states[-5:], states[:, :5], states[:, -5:] = 100, 100, 100, 100
    made = ObstacleLayer(CONFIG)
    made.set_map(states, 0.05, (-4.25, -3.25))
    return made


def look(made, segments, stamp, pose=HERE):
    """A lidar scan from the vehicle at a pose."""
    sensor = np.array([*(pose[:2] + 0.3 * np.array([np.cos(pose[2]), np.sin(pose[2])])), pose[2]])
    return made.hear(scan(segments, sensor, stamp=stamp), pose)


def low_box(x0, x1, y0, y1, top=0.12):
    """Front and top of a low box for `picture`."""
    return [
        [(x0, y0, 0), (0, y1 - y0, 0), (0, 0, top)],
        [(x0, y0, top), (x1 - x0, 0, 0), (0, y1 - y0, 0)],
    ]


def see(made, planes, stamp, pose=HERE):
    """A depth picture from the vehicle at a pose."""
    depth = picture([FLOOR, *planes], CONFIG.rgbd, CONFIG.rgbd.T_base_camera, pose, stamp=stamp)
    return made.hear(depth, pose)


def occupied(made, x, y):
    i, j = made.lidar.cells(np.array([x, y]))
    return made.states()[i, j] == OCCUPIED


def test_lidar_puts_an_obstacle_in_and_takes_it_out_when_it_has_gone():
    made = layer()
    for k in range(5):
        assert look(made, np.concatenate([ROOM, CARTON]), 0.1 * k) is None
    assert occupied(made, 1.52, 0.0)
    for k in range(5, 12):
        look(made, ROOM, 0.1 * k)
    assert not made.live.any()


def test_the_map_itself_is_never_cleared():
    made = layer()
    far = box(-20, -20, 20, 20)  # the lidar looks through where the walls are drawn
    for k in range(30):
        look(made, far, 0.1 * k)
    assert occupied(made, 4.05, 0.0) and not made.live.any()


def test_what_is_seen_at_a_drawn_wall_is_the_wall():
    made = layer()
    moved = box(-3.95, -2.95, 3.95, 2.95)  # 5 cm off: an error of the pose
    for k in range(10):
        look(made, moved, 0.1 * k)
    assert not made.live.any()


def test_a_low_box_stays_when_the_lidar_looks_over_it_and_the_camera_loses_it():
    made = layer()
    assert see(made, low_box(1.5, 1.9, -0.2, 0.2), 0.0) is None
    assert occupied(made, 1.52, 0.0)
    assert occupied(made, 1.82, 0.0)  # its top, behind the front
    nearer = np.array([0.6, 0.0, 0.0])  # now it lies under the picture
    for k in range(1, 40):
        look(made, ROOM, 0.1 * k, nearer)
        see(made, [], 0.1 * k + 0.01, nearer)
    assert occupied(made, 1.52, 0.0)


def test_a_low_box_that_was_taken_away_is_cleared_by_the_camera():
    made = layer()
    for k in range(3):
        see(made, low_box(1.5, 1.9, -0.2, 0.2), 0.1 * k)
    back = np.array([-0.6, 0.0, 0.0])
    for k in range(3, 15):
        see(made, [], 0.1 * k, back)
    assert not occupied(made, 1.52, 0.0)


def test_the_lidar_clears_what_both_have_seen():
    made = layer()
    tall = [[(1.51, -0.2, 0), (0, 0.4, 0), (0, 0, 0.6)]]
    for k in range(4):
        look(made, np.concatenate([ROOM, CARTON]), 0.1 * k)
        see(made, tall, 0.1 * k + 0.01)
    turned = np.array([0.0, 0.0, 2.0])  # the camera looks elsewhere
    for k in range(4, 15):
        look(made, ROOM, 0.1 * k, turned)
    assert not occupied(made, 1.52, 0.0)


def bad_scans():
    good = scan(ROOM, HERE, stamp=1.0)
    yield "late", LidarScan(0.2, FIRST, STEP, good.ranges, 30.0), HERE
    yield "again", LidarScan(1.0, FIRST, STEP, good.ranges, 30.0), HERE
    yield "nan", LidarScan(2.0, FIRST, STEP, np.full(BEAMS, np.nan), 30.0), HERE
    yield "empty", LidarScan(2.0, FIRST, STEP, np.zeros(0), 30.0), HERE
    yield "stamp", LidarScan(np.nan, FIRST, STEP, good.ranges, 30.0), HERE
    yield "no pose", LidarScan(2.0, FIRST, STEP, good.ranges, 30.0), None
    yield "nan pose", LidarScan(2.0, FIRST, STEP, good.ranges, 30.0), np.full(3, np.nan)
    rgb, depth = np.zeros((240, 424, 3), np.uint8), np.zeros((240, 424), np.uint16)
    yield "blind", RgbdFrame(2.0, rgb, depth), HERE
    yield "late picture", RgbdFrame(0.1, rgb, depth + 1500), HERE


@pytest.mark.parametrize("name, reading, pose", list(bad_scans()), ids=lambda v: str(v)[:12])
def test_bad_readings_are_dropped_in_one_line_and_change_nothing(name, reading, pose):
    made = layer()
    look(made, np.concatenate([ROOM, CARTON]), 0.9)
    look(made, np.concatenate([ROOM, CARTON]), 1.0)
    lidar, depth = made.lidar.log_odds.copy(), made.depth.log_odds.copy()
    why = made.hear(reading, pose)
    assert why and "\n" not in why and made.dropped == 1
    np.testing.assert_array_equal(made.lidar.log_odds, lidar)
    np.testing.assert_array_equal(made.depth.log_odds, depth)
    assert look(made, ROOM, 2.1) is None  # and the next good one counts


def test_forgetting_keeps_what_lies_near():
    made = layer()
    see(made, low_box(1.0 + 0.5, 1.9, -0.2, 0.2), 0.0)
    look(made, np.concatenate([ROOM, CARTON]), 0.1)
    made.forget(HERE, keep=1.7)
    assert occupied(made, 1.52, 0.0) and not occupied(made, 1.85, 0.0)


def test_a_new_map_of_the_same_place_keeps_what_was_seen():
    made = layer()
    see(made, low_box(1.5, 1.9, -0.2, 0.2), 0.0)
    made.set_map(made._drawn.copy(), 0.05, (-4.25, -3.25))
    assert occupied(made, 1.52, 0.0)
    made.set_map(made._drawn.copy(), 0.05, (-4.0, -3.25))
    assert not made.live.any()


# --- what moves ----------------------------------------------------------------------------------


def cart(x, y):
    return box(x - 0.24, y - 0.2, x + 0.26, y + 0.2)


def test_a_cart_is_followed_at_its_speed_and_kept_out_of_the_grid():
    made = layer()
    for k in range(25):
        look(made, np.concatenate([ROOM, cart(2.0, -1.5 + 0.04 * k)]), 0.1 * k)
    rows = made.moving.obstacles(2.4)
    assert len(rows) == 1
    np.testing.assert_allclose(rows[0, 5:], [0.0, 0.4], atol=0.08)
    middle = 0.5 * (rows[0, :2] + rows[0, 2:4])
    assert np.hypot(*(middle - [2.0, -0.54])) < 0.15
    assert not occupied(made, 1.77, -0.54)  # its front now
    assert not occupied(made, 1.77, -1.5)  # and where it was at first


def test_things_that_stand_do_not_move_though_the_vehicle_sees_them_from_all_sides():
    made = layer()
    for k in range(40):
        pose = np.array([-1.5 + 0.08 * k, -1.0, 0.3])
        look(made, np.concatenate([ROOM, cart(1.0, 0.5)]), 0.1 * k, pose)
        assert len(made.moving.obstacles(0.1 * k)) == 0
    assert occupied(made, 1.0, 0.3)


def test_a_cart_that_stops_is_an_obstacle_but_its_lane_is_remembered():
    made = layer()
    for k in range(60):
        look(made, np.concatenate([ROOM, cart(2.0, -1.5 + 0.04 * min(k, 20))]), 0.1 * k)
    assert len(made.moving.obstacles(5.9)) == 0
    assert occupied(made, 1.77, -0.7)
    start, end, _ = made.moving.lanes(5.9)[0]
    assert end[1] - start[1] > 0.6  # on its old way


def test_the_way_of_a_cart_that_is_lost_from_sight_is_remembered_for_a_while():
    """Seen from x = 0 to 0.55 m at 0.5 m/s, given up after 4 s, its way on kept for 20 s more."""
    objects = MovingObjects()
    for k in range(12):
        face = np.column_stack([np.full(9, 0.05 * k), np.linspace(-0.2, 0.2, 9)])
        objects.update(0.1 * k, face)
    for k in range(12, 60):
        objects.update(0.1 * k, np.zeros((0, 2)), in_view=lambda xy: False)
    assert len(objects.obstacles(5.9)) == 0
    ((start, end, half),) = objects.lanes(5.9)
    assert start[0] < 0.1 and end[0] == pytest.approx(0.55 + 4 * 0.5, abs=0.4) and 0.2 < half < 0.4
    assert objects.lanes(26.0) == []


def test_what_goes_out_of_the_lidars_view_is_expected_to_go_on():
    objects = MovingObjects()
    for k in range(12):
        face = np.column_stack([np.full(9, 0.05 * k), np.linspace(-0.2, 0.2, 9)])
        objects.update(0.1 * k, face)
    assert len(objects.obstacles(1.1)) == 1
    for k in range(12, 32):
        objects.update(0.1 * k, np.zeros((0, 2)), in_view=lambda xy: False)
    row = objects.obstacles(3.1)[0]
    assert row[0] == pytest.approx(0.5 * 3.1, abs=0.25)
    for k in range(32, 60):
        objects.update(0.1 * k, np.zeros((0, 2)), in_view=lambda xy: True)
    assert len(objects.obstacles(5.9)) == 0


def test_clusters_are_cut_at_gaps_and_lone_points_left_out():
    points = np.array([[0, 0], [0, 0.1], [0, 0.2], [0, 0.3], [0, 1], [2, 2], [2, 2.1], [2, 2.2]])
    parts = clusters(points.astype(float), 0.25, 3)
    assert [len(p) for p in parts] == [4, 3]


def test_what_leaves_the_view_is_expected_to_go_on_as_it_went():
    """Expected result: the part that is still seen does not turn the track aside."""
    moving, low = MovingObjects(), np.radians(-45.0)
    for k in range(60):  # a cart goes past an eye at the origin, out of its view
        centre = np.array([1.2, 1.2 - 0.5 * 0.1 * k])
        y = centre[1] + np.linspace(-0.25, 0.25, 41)
        face = np.column_stack([np.full(41, centre[0] - 0.2), y])
        bearing = np.arctan2(face[:, 1], face[:, 0])
        face, bearing = face[bearing > low], bearing[bearing > low]
        moving.update(
            0.1 * k, face, np.zeros(2), lambda p: np.arctan2(p[1], p[0]) > low, bearing < low + 0.03
        )
        assert len(moving.objects) == 1
        if k > 10:
            track = moving.objects[0]
            assert track.moves and track.mean[1] == pytest.approx(centre[1], abs=0.2)
            assert track.mean[3] == pytest.approx(-0.5, abs=0.1)


def looked(made, x, y):
    i, j = made.lidar.cells(np.array([x, y]))
    return bool(made.looked[i, j])


def test_the_layer_knows_where_the_camera_has_looked():
    made = layer()
    assert not made.looked.any()
    see(made, [], 0.0)
    assert looked(made, 2.0, 0.0) and looked(made, 0.0, 0.0)  # ahead, and where it stands
    assert not looked(made, 0.0, 0.8) and not looked(made, -0.8, 0.0)
    see(made, [], 0.1, np.array([-1.5, 0.0, np.pi / 2]))
    assert looked(made, -1.5, 2.0) and looked(made, 2.0, 0.0)
    made.forget(np.array([-1.5, 0.0, 0.0]), keep=1.0)
    assert not looked(made, 2.0, 0.0) and looked(made, -1.5, 0.0)
