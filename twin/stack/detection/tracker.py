"""Follows parts over frames: where each is at any time, what it is, and how fast the belt runs.

Everything is held in the odometry frame of the fused estimate, so the vehicle may move meanwhile.
All parts ride on one belt: its velocity is estimated from all tracks together,

    p_ki = a_k + v t_ki + noise,   minimised over all a_k and one v,

and each track keeps only its own offset a_k. A track that is out of sight coasts at v: it is right
as long as the belt runs as it did when the part was last seen.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from twin.geometry import Array, between2, compose2, rot2, wrap_angle
from twin.messages import PART_CLASSES, Detection, PartClass, TrackedPart
from twin.stack.config import StackConfig
from twin.stack.detection.window import X_WINDOW

GATE = 0.04  # m; parts are fed at least 0.08 m apart
MEMORY = 60  # observations a track, three seconds at 20 Hz
POSITION_TIME = 1.0  # s: older observations weigh less, so that the vehicle's drift does not stay
CONFIRMED = 3  # hits until a track is told of
TENTATIVE_TIME = 0.3  # s unseen after which an unconfirmed track is dropped
UNSEEN = 20  # frames that a part may stay unseen where it ought to be seen, before it is dropped
SEEN_MARGIN = 0.06  # m inside the window's ends, where a part is surely whole in it
VELOCITY_SPAN, VELOCITY_HITS = 0.2, 5  # s and hits a track needs to speak of the belt
HUBER = 0.0015  # m: residuals beyond count less
CONFIDENCE = (0.3, 0.9)  # of one frame: successive frames err alike
YAW_SPREAD = np.radians(20.0)


@dataclass
class _Track:
    track_id: int
    observations: deque = field(default_factory=lambda: deque(maxlen=MEMORY))  # t, x, y, yaw, class
    log_likelihood: Array = field(default_factory=lambda: np.zeros(len(PART_CLASSES)))
    hits: int = 0
    unseen: int = 0
    mean: Array = field(default_factory=lambda: np.zeros(3))  # t, x, y
    yaw: float = 0.0

    def add(self, stamp: float, pose: Array, detection: Detection) -> None:
        index = PART_CLASSES.index(detection.part_class)
        confidence = float(np.clip(detection.confidence, *CONFIDENCE))
        likelihood = np.full(len(PART_CLASSES), (1 - confidence) / (len(PART_CLASSES) - 1))
        likelihood[index] = confidence
        self.log_likelihood += np.log(likelihood)
        self.observations.append((stamp, *pose, index))
        self.hits += 1
        self.unseen = 0
        self._summarise()

    @property
    def part_class(self) -> tuple[PartClass, float]:
        weight = np.exp(self.log_likelihood - self.log_likelihood.max())
        index = int(np.argmax(weight))
        return PART_CLASSES[index], float(weight[index] / weight.sum())

    def _summarise(self) -> None:
        """Weighted mean time, place and yaw; the state at any time follows by the velocity."""
        seen = np.array(self.observations)
        same = seen[:, 4] == int(np.argmax(self.log_likelihood))
        seen = seen[same] if same.any() else seen
        weight = np.exp((seen[:, 0] - seen[-1, 0]) / POSITION_TIME)
        self.mean = weight @ seen[:, :3] / weight.sum()
        # A frame may see the part turned by half: take the yaw that most frames agree on.
        yaw = seen[:, 3]
        apart = np.abs(wrap_angle(yaw[:, None] - yaw[None, :]))
        agree = apart[np.argmax((apart < YAW_SPREAD) @ weight)] < YAW_SPREAD
        sine, cosine = weight[agree] @ np.sin(yaw[agree]), weight[agree] @ np.cos(yaw[agree])
        self.yaw = float(np.arctan2(sine, cosine))

    def expected(self, stamp: float, velocity: Array) -> Array:
        """x, y, yaw where the next frame should show it. Shape (3,).

        From the last frame alone: that holds also while the belt's velocity is wrong or unknown.
        """
        t, x, y, yaw, _ = self.observations[-1]
        return np.array([x + velocity[0] * (stamp - t), y + velocity[1] * (stamp - t), yaw])

    def state(self, stamp: float, velocity: Array) -> Array:
        """x, y, yaw at a time, from all frames. Shape (3,)."""
        return np.array([*(self.mean[1:] + velocity * (stamp - self.mean[0])), self.yaw])


class Tracker:
    """Tracks of parts on the belt.

    Args:
        config: gives the line and the height of its face.
    """

    def __init__(self, config: StackConfig):
        self._line = config.site.line
        self._tracks: list[_Track] = []
        self._next_id = 0
        self._velocity: Array | None = None

    @property
    def belt_velocity(self) -> Array | None:
        """Velocity of the belt in odom, (2,) m/s; None until parts have been seen to move."""
        return self._velocity

    def update(self, stamp: float, detections: tuple[Detection, ...], pose: Array) -> None:
        """Take in one frame.

        Args:
            stamp: time of exposure.
            detections: in the base frame at exposure.
            pose: fused pose of the base in odom at exposure, (3,).
        """
        velocity = self._velocity if self._velocity is not None else np.zeros(2)
        states = [track.expected(stamp, velocity) for track in self._tracks]
        measured = [compose2(pose, (*d.p_base[:2], d.yaw)) for d in detections]
        pairs = sorted(
            (float(np.hypot(*(m[:2] - s[:2]))), i, j)
            for i, s in enumerate(states)
            for j, m in enumerate(measured)
        )
        matched: dict[int, int] = {}
        taken: set[int] = set()
        for distance, i, j in pairs:
            if distance > GATE:
                break
            if i not in matched and j not in taken:
                matched[i] = j
                taken.add(j)
        for i, track in enumerate(self._tracks):
            if i in matched:
                track.add(stamp, measured[matched[i]], detections[matched[i]])
            elif self._ought_to_be_seen(states[i], pose):
                track.unseen += 1
        for j, detection in enumerate(detections):
            if j not in taken:
                track = _Track(self._next_id)
                self._next_id += 1
                track.add(stamp, measured[j], detection)
                self._tracks.append(track)
        self._estimate_velocity(stamp)
        self._purge(stamp)

    def predict(self, time: float) -> tuple[TrackedPart, ...]:
        """Confirmed tracks carried to a time, past or future, oldest first.

        None before the belt's velocity is known: where a part goes is not known either.
        """
        velocity = self._velocity
        if velocity is None:
            return ()
        parts = []
        for track in self._tracks:
            if track.hits < CONFIRMED:
                continue
            x, y, yaw = track.state(time, velocity)
            part_class, confidence = track.part_class
            parts.append(
                TrackedPart(
                    track_id=track.track_id,
                    part_class=part_class,
                    confidence=confidence,
                    p_odom=np.array([x, y, self._line.height]),
                    velocity_in_odom=np.array([*velocity, 0.0]),
                    yaw=float(yaw),
                    hits=track.hits,
                )
            )
        return tuple(parts)

    def drop(self, track_id: int) -> None:
        """Forget a part, because an arm took it."""
        self._tracks = [t for t in self._tracks if t.track_id != track_id]

    def _estimate_velocity(self, stamp: float) -> None:
        """Joint least squares with Huber weights over all tracks that were seen lately."""
        times, points = [], []
        for track in self._tracks:
            seen = np.array(track.observations)[:, :3]
            recent = len(seen) >= VELOCITY_HITS and stamp - seen[-1, 0] < 2.0
            if recent and seen[-1, 0] - seen[0, 0] >= VELOCITY_SPAN:
                times.append(seen[:, 0])
                points.append(seen[:, 1:])
        if not times:
            return
        weights = [np.ones(len(t)) for t in times]
        velocity = np.zeros(2)
        for _ in range(3):
            spread, product, centred = 0.0, np.zeros(2), []
            for t, p, w in zip(times, points, weights, strict=True):
                dt, dp = t - w @ t / w.sum(), p - w @ p / w.sum()
                centred.append((dt, dp))
                spread += float(w @ dt**2)
                product += (w * dt) @ dp
            velocity = product / spread
            residuals = [np.linalg.norm(dp - np.outer(dt, velocity), axis=1) for dt, dp in centred]
            weights = [HUBER / np.maximum(r, HUBER) for r in residuals]
        self._velocity = velocity

    def _ought_to_be_seen(self, state: Array, pose: Array) -> bool:
        x, y, _ = between2(pose, state)
        inside = X_WINDOW[0] + SEEN_MARGIN < x < X_WINDOW[1] - SEEN_MARGIN
        return bool(inside and 0.30 < y < 0.60)

    def _purge(self, stamp: float) -> None:
        velocity = self._velocity if self._velocity is not None else np.zeros(2)

        def alive(track: _Track) -> bool:
            if track.hits < CONFIRMED and stamp - track.observations[-1][0] > TENTATIVE_TIME:
                return False
            offset = track.state(stamp, velocity)[:2] - self._line.origin
            along = float((rot2(self._line.direction).T @ offset)[0])
            return track.unseen <= UNSEEN and along < self._line.length

        self._tracks = [track for track in self._tracks if alive(track)]
