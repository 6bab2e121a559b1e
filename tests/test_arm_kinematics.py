"""Kinematics and dynamics of the arm against MuJoCo and against themselves."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin.geometry import apply, inverse, rot_y, rot_z, transform
from twin.layout import models_dir
from twin.stack.config import Arm, Tray, arm_mounts
from twin.stack.control.arm_dynamics import ArmDynamics
from twin.stack.control.arm_kinematics import ArmKinematics, Unreachable

ARM_XML = models_dir() / "arm" / "arm.xml"
ARM = Arm()
KINEMATICS = ArmKinematics(ARM)
joints = st.tuples(*(st.floats(lo, hi) for lo, hi in zip(ARM.lower, ARM.upper, strict=True)))


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(ARM_XML))


def test_forward_kinematics_agree_three_ways(model):
    data, dynamics = mujoco.MjData(model), ArmDynamics(ARM_XML)
    assert list(dynamics.model.names)[1:] == [f"joint{i}" for i in range(1, 7)]
    assert dynamics.model.nq == 6
    rng = np.random.default_rng(0)
    for _ in range(200):
        q = rng.uniform(ARM.lower, ARM.upper)
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        site = data.site("tcp")
        T = transform(site.xmat.reshape(3, 3), site.xpos)
        np.testing.assert_allclose(KINEMATICS.forward(q), T, atol=1e-9)
        np.testing.assert_allclose(dynamics.forward(q), T, atol=1e-9)


def test_model_and_belief_share_limits(model):
    for i in range(6):
        joint = model.joint(f"joint{i + 1}")
        np.testing.assert_allclose(joint.range, (ARM.lower[i], ARM.upper[i]))
        assert model.actuator(f"motor{i + 1}").ctrlrange[1] == ARM.max_torque[i]


def test_inverse_dynamics_agree_with_mujoco(model):
    """Without friction, which MuJoCo resolves as a constraint."""
    model = mujoco.MjModel.from_xml_path(str(ARM_XML))
    model.dof_frictionloss[:] = 0.0
    data, dynamics = mujoco.MjData(model), ArmDynamics(ARM_XML)
    dynamics._friction = np.zeros(6)
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, qd, qdd = rng.uniform(-1.5, 1.5, 6), rng.uniform(-2, 2, 6), rng.uniform(-9, 9, 6)
        data.qpos[:], data.qvel[:], data.qacc[:] = 0.0125, 0.0, 0.0
        data.qpos[:6], data.qvel[:6], data.qacc[:6] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(
            dynamics.torque(q, qd, qdd), data.qfrc_inverse[:6], atol=0.02, rtol=1e-3
        )


def test_payload_weighs_on_the_arm():
    dynamics, q = ArmDynamics(ARM_XML), np.array([0.0, 0.8, 0.6, 0.0, 1.74, 0.0])
    empty = dynamics.torque(q, np.zeros(6), np.zeros(6))
    dynamics.set_payload(0.5)
    loaded = dynamics.torque(q, np.zeros(6), np.zeros(6))
    lever = KINEMATICS.forward(q)[0, 3]
    assert loaded[1] - empty[1] == pytest.approx(-0.5 * 9.81 * lever, rel=1e-6)
    dynamics.set_payload(0.0)
    np.testing.assert_allclose(dynamics.torque(q, np.zeros(6), np.zeros(6)), empty)


@settings(max_examples=300, deadline=None)
@given(joints)
def test_inverse_returns_where_it_came_from(q):
    q = np.array(q)
    T = KINEMATICS.forward(q)
    found = KINEMATICS.inverse(T, q)
    np.testing.assert_allclose(KINEMATICS.forward(found), T, atol=1e-6)
    assert (found >= KINEMATICS.lower).all() and (found <= KINEMATICS.upper).all()
    for solution in KINEMATICS.solutions(T):
        np.testing.assert_allclose(KINEMATICS.forward(solution), T, atol=1e-6)


@settings(max_examples=100, deadline=None)
@given(joints)
def test_jacobian_is_the_derivative(q):
    q, h = np.array(q), 1e-6
    J, T = KINEMATICS.jacobian(q), KINEMATICS.forward(q)
    for i in range(6):
        dT = (KINEMATICS.forward(q + h * np.eye(6)[i]) - KINEMATICS.forward(q)) / h
        W = dT[:3, :3] @ T[:3, :3].T
        twist = np.array([*dT[:3, 3], W[2, 1], W[0, 2], W[1, 0]])
        np.testing.assert_allclose(J[:, i], twist, atol=1e-5)


def down_pose(position, yaw: float) -> np.ndarray:
    """`T_mount_tcp` of a hand that points down and closes along `yaw` in mount, rad."""
    return transform(rot_z(yaw - np.pi / 2) @ rot_y(np.pi), position)


@settings(max_examples=200, deadline=None)
@given(st.floats(0.20, 0.48), st.floats(-2.5, 2.5), st.floats(0.02, 0.25), st.floats(-np.pi, np.pi))
def test_hand_down_closed_form_agrees_with_general_one(radius, angle, z, yaw):
    p = np.array([radius * np.cos(angle), radius * np.sin(angle), z])
    q = KINEMATICS.inverse_down(p[None], np.array([yaw]))[0]
    T = down_pose(p, yaw)
    reached = KINEMATICS.forward(q)
    np.testing.assert_allclose(reached[:3, 3], p, atol=1e-9)
    # The same up to half a turn of the hand.
    assert abs(abs(reached[:3, 1] @ T[:3, 1]) - 1) < 1e-9 and reached[2, 2] < -1 + 1e-9
    np.testing.assert_allclose(KINEMATICS.inverse(T, q, symmetric=True), q, atol=1e-6)


def test_symmetric_hand_turns_less():
    p, seed = (0.4, 0.0, 0.2), np.array([0.0, 0.3, 1.3, 0.0, 1.5, 0.0])
    turned = KINEMATICS.inverse(down_pose(p, np.pi / 2 + np.pi), seed, symmetric=True)
    assert abs(turned[5]) < 1e-6


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ((0.9, 0.0, 0.2), "can be reached"),
        ((0.06, 0.0, 0.0), "joint 3"),
        ((-0.4, 0, 0.2), "joint 1"),
    ],
)
def test_out_of_reach_says_why(position, words):
    with pytest.raises(Unreachable, match=words):
        KINEMATICS.inverse_down(np.array([position]), np.zeros(1))
    if words == "can be reached":  # the general inverse may bend over backwards
        with pytest.raises(Unreachable):
            KINEMATICS.inverse(down_pose((0.9, 0.0, 0.2), 0.0), np.zeros(6))


@pytest.mark.parametrize("arm", [0, 1])
def test_whole_workplace_is_within_reach(arm):
    """Every slot, and the belt window at every height, elbow up and away from singularities."""
    T_mount_base = inverse(arm_mounts()[arm])
    windows = ((0.03, 0.22), (-0.50, -0.10))
    points = [s + np.array([0, 0, dz]) for s in Tray().slots() for dz in (0.008, 0.12)]
    points += [
        np.array([x, y, z])
        for x in np.linspace(*windows[arm], 5)
        for y in (0.40, 0.45, 0.50)
        for z in (0.705, 0.76, 0.82)
    ]
    q = KINEMATICS.inverse_down(apply(T_mount_base, np.array(points)), np.zeros(len(points)))
    margin = np.minimum(q - KINEMATICS.lower, KINEMATICS.upper - q)[:, :5].min()
    elbow = [KINEMATICS.frames(x)[1][2, 2] + 0.55 for x in q]
    assert margin > 0.07  # rad from every limit
    assert np.sin(q[:, 2]).min() > 0.45 and np.sin(q[:, 4]).min() > 0.5  # elbow, wrist
    assert max(elbow) < 1.05
