"""Forward and inverse kinematics of the six-joint arm, in closed form.

Frames: `mount` stands on the deck, z up, x to the arm's front; `tcp` lies between the fingertips,
z out of the hand, y along the fingers' closing. At q = 0 the arm is a candle: everything points
up and the two frames are parallel. Joints 1, 4, 6 turn about z, joints 2, 3, 5 about y:

    T_mount_tcp = Tz(h) Rz(q1) Ry(q2) Tz(a) Ry(q3) Tz(b) Rz(q4) Ry(q5) Rz(q6) Tz(c)

with h shoulder height, a upper arm, b forearm and c wrist centre to TCP. Joints 4, 5, 6 meet in
one point (spherical wrist), so position and orientation part (Pieper 1968; Siciliano et al.,
"Robotics: Modelling, Planning and Control", section 2.12).
"""

from itertools import product

import numpy as np

from twin.geometry import Array, rot_y, rot_z, transform, wrap_angle
from twin.stack.config import Arm

ROUNDING = 1e-9  # by which a pose may miss the border of the reachable


class Unreachable(ValueError):
    """No joint angles put the hand there. The message says why."""


class ArmKinematics:
    """Closed-form kinematics of one arm's drawing."""

    def __init__(self, arm: Arm):
        self.h, self.a, self.b = arm.shoulder_height, arm.upper_arm, arm.forearm
        self.c = arm.flange + arm.tool
        self.lower, self.upper = np.array(arm.lower), np.array(arm.upper)

    def frames(self, q: Array) -> tuple[Array, Array]:
        """Joint axes (6, 3) and origins (7, 3) in mount; the seventh origin is the TCP."""
        R1 = rot_z(q[0])
        R2 = R1 @ rot_y(q[1])
        R3 = R2 @ rot_y(q[2])
        R4 = R3 @ rot_z(q[3])
        R5 = R4 @ rot_y(q[4])
        shoulder = np.array([0.0, 0.0, self.h])
        elbow = shoulder + self.a * R2[:, 2]
        wrist = elbow + self.b * R3[:, 2]
        tcp = wrist + self.c * R5[:, 2]
        axes = np.array([R1[:, 2], R1[:, 1], R2[:, 1], R3[:, 2], R4[:, 1], R5[:, 2]])
        return axes, np.array([shoulder, shoulder, elbow, wrist, wrist, wrist, tcp])

    def forward(self, q: Array) -> Array:
        """`T_mount_tcp` of joint angles q. Shape (4, 4)."""
        R3 = rot_z(q[0]) @ rot_y(q[1] + q[2])
        R = R3 @ rot_z(q[3]) @ rot_y(q[4]) @ rot_z(q[5])
        upper = rot_z(q[0]) @ rot_y(q[1])
        p = self.a * upper[:, 2] + self.b * R3[:, 2] + self.c * R[:, 2]
        return transform(R, np.array([p[0], p[1], p[2] + self.h]))

    def jacobian(self, q: Array) -> Array:
        """Twist of the TCP in mount axes (linear, then angular) per joint speed. Shape (6, 6)."""
        axes, origins = self.frames(q)
        linear = np.asarray(np.cross(axes, origins[6] - origins[:6]), dtype=np.float64)
        return np.vstack([linear.T, axes.T])

    def solutions(self, T_mount_tcp: Array) -> Array:
        """All joint angles that reach a pose, limits ignored. Shape (n, 6), n up to 8.

        Raises:
            Unreachable: the wrist centre lies outside the reach of upper arm and forearm.
        """
        R = T_mount_tcp[:3, :3]
        x, y, z = T_mount_tcp[:3, 3] - self.c * R[:, 2] - (0.0, 0.0, self.h)
        distance2 = x * x + y * y + z * z
        cos_elbow = (distance2 - self.a**2 - self.b**2) / (2 * self.a * self.b)
        if abs(cos_elbow) > 1.0 + ROUNDING:
            tcp = ", ".join(f"{c:.3f}" for c in T_mount_tcp[:3, 3])
            raise Unreachable(
                f"TCP at ({tcp}) m in mount: the wrist would stand {np.sqrt(distance2):.3f} m"
                f" from the shoulder; {abs(self.a - self.b):.3f} to {self.a + self.b:.3f} m"
                f" can be reached"
            )
        radius = np.hypot(x, y)
        found = []
        for front, bend in product((1.0, -1.0), (1.0, -1.0)):
            q1 = np.arctan2(front * y, front * x)
            q3 = bend * np.arccos(np.clip(cos_elbow, -1.0, 1.0))
            # Angle of the shoulder-wrist line from the vertical, less its angle to the upper arm.
            q2 = np.arctan2(front * radius, z) - np.arctan2(
                self.b * np.sin(q3), self.a + self.b * np.cos(q3)
            )
            W = rot_y(-q2 - q3) @ rot_z(-q1) @ R  # = Rz(q4) Ry(q5) Rz(q6)
            sin5 = np.hypot(W[0, 2], W[1, 2])
            for flip in (1.0, -1.0):
                q5 = np.arctan2(flip * sin5, W[2, 2])
                if sin5 > 1e-9:
                    q4 = np.arctan2(flip * W[1, 2], flip * W[0, 2])
                    q6 = np.arctan2(flip * W[2, 1], -flip * W[2, 0])
                else:  # axes 4 and 6 fall together: only their sum counts
                    q4, q6 = 0.0, np.arctan2(W[1, 0], W[0, 0])
                found.append((q1, q2, q3, q4, q5, q6))
        return wrap_angle(np.array(found))

    def inverse_down(self, position: Array, yaw: Array, near: float = 0.0) -> Array:
        """Joint angles of a hand pointing straight down, elbow up, joint 4 at zero. Shape (n, 6).

        One closed form for many points: with the hand down the arm stays in the vertical plane
        through joint 1, and joint 6 turns the fingers, which are alike (yaw modulo half a turn).

        Args:
            position: TCP in mount, m. Shape (n, 3).
            yaw: closing direction in mount, rad, continuous along the points. Shape (n,).
            near: joint 6 of the first point is the choice nearest to this, rad.

        Raises:
            Unreachable: a point is too far, too near, or beyond a joint's limit.
        """
        x, y, z = np.asarray(position, dtype=float).T
        radius, height = np.hypot(x, y), z + self.c - self.h
        cos_elbow = (radius**2 + height**2 - self.a**2 - self.b**2) / (2 * self.a * self.b)
        worst = int(np.argmax(np.abs(cos_elbow)))
        if abs(cos_elbow[worst]) > 1.0 + ROUNDING:
            raise Unreachable(
                f"TCP at ({x[worst]:.3f}, {y[worst]:.3f}, {z[worst]:.3f}) m in mount:"
                f" the wrist would stand {np.hypot(radius, height)[worst]:.3f} m from the shoulder;"
                f" {abs(self.a - self.b):.3f} to {self.a + self.b:.3f} m can be reached"
            )
        q1 = np.unwrap(np.arctan2(y, x))
        cos_elbow = np.clip(cos_elbow, -1.0, 1.0)
        q3 = np.arccos(cos_elbow)
        q2 = np.arctan2(radius, height) - np.arctan2(
            self.b * np.sin(q3), self.a + self.b * cos_elbow
        )
        q6 = q1 + np.pi / 2 - np.asarray(yaw)
        q6 = q6 - np.pi * np.round((q6[0] - near) / np.pi)
        q = np.column_stack([q1, q2, q3, np.zeros_like(q1), np.pi - q2 - q3, q6])
        over = np.maximum(q - self.upper, self.lower - q)
        point, joint = np.unravel_index(int(np.argmax(over)), over.shape)
        if over[point, joint] > ROUNDING:
            raise Unreachable(
                f"TCP at ({x[point]:.3f}, {y[point]:.3f}, {z[point]:.3f}) m in mount:"
                f" joint {joint + 1} would have to stand at {q[point, joint]:.3f} rad;"
                f" it may go from {self.lower[joint]:.3f} to {self.upper[joint]:.3f}"
            )
        return q

    def inverse(self, T_mount_tcp: Array, seed: Array, symmetric: bool = False) -> Array:
        """Joint angles within the limits that reach a pose, the nearest to `seed`. Shape (6,).

        Args:
            T_mount_tcp: wanted pose.
            seed: joint angles to stay near to, rad. Shape (6,).
            symmetric: the hand may be turned by half a turn (its two fingers are alike).

        Raises:
            Unreachable: too far, too near, or only beyond a joint's limit.
        """
        q = self.solutions(T_mount_tcp)
        # Every joint may stand whole turns away; joint 6 half a turn where the fingers may swap.
        step = np.array([2.0 * np.pi] * 5 + [np.pi if symmetric else 2.0 * np.pi])
        q = q + step * np.round((seed - q) / step)
        too_far, too_near = q > self.upper + ROUNDING, q < self.lower - ROUNDING
        q = np.where(too_far, q - step, np.where(too_near, q + step, q))
        over = np.maximum(q - self.upper, self.lower - q)
        good = (over <= ROUNDING).all(axis=1)
        if not good.any():
            best = int(np.argmin(over.max(axis=1)))
            joint = int(np.argmax(over[best]))
            raise Unreachable(
                f"joint {joint + 1} would have to stand at {q[best, joint]:.3f} rad;"
                f" it may go from {self.lower[joint]:.3f} to {self.upper[joint]:.3f}"
            )
        q = np.clip(q[good], self.lower, self.upper)
        return q[int(np.argmin(np.abs(q - seed).sum(axis=1)))]
