"""What a floor tag does to the estimated pose.

Xu et al., section 3: where the pose by tag differs from the predicted one by more than a threshold
tau, it replaces it and sampling goes on from there; below, the two are fused. A tag may lie: a
wrong code, one printed for another place, one stuck down askew. So a tag must be in the survey and
say so itself, and one that contradicts the estimate must fit the lidar's last scan.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.geometry import Array, between2, compose2, rot2, wrap_angle
from twin.stack.detection.qr import TagFix

# Squared Mahalanobis distance between tag and estimate: chi-square, 3 degrees of freedom, 99.9 %.
GATE = 16.27


@dataclass(frozen=True)
class TagPolicy:
    """Thresholds; on the plant, seeds 0-4, no true tag was refused or taken for a reset.

    Attributes:
        tau, tau_yaw: from the estimate, m and rad, beyond which a tag replaces it.
        survey, survey_yaw: by which a tag's text may differ from the survey, m and rad.
        consent: fit of the scan at the tag's pose over that at the estimate, below which the tag
            is taken to lie.
        forget: s without a sight of a tag after which its next one is a new pass.
    """

    tau: float = 0.10
    tau_yaw: float = float(np.radians(5.0))
    survey: float = 0.005
    survey_yaw: float = float(np.radians(0.5))
    consent: float = 0.8
    forget: float = 5.0


@dataclass(frozen=True)
class TagDecision:
    """What became of a fix. Pose and covariance are to be taken over unless it was refused."""

    action: Literal["reset", "fused", "refused"]
    pose: Array  # x, y, yaw in world at the exposure. Shape (3,)
    covariance: Array  # shape (3, 3)
    reason: str = ""  # of a refusal, one line


class QrFusion:
    """Judges fixes one by one.

    Args:
        tags: surveyed pose (x, y, yaw in world) of each tag's id.
        policy: thresholds.
    """

    def __init__(
        self, tags: Mapping[str, tuple[float, float, float]], policy: TagPolicy | None = None
    ):
        self._tags, self._policy = dict(tags), policy or TagPolicy()
        self._stamp, self._last_id = -np.inf, ""
        self._lies, self._first = np.zeros(3), np.eye(3)  # tag and covariance after a first sight

    def update(
        self,
        fix: TagFix,
        pose: Array,
        covariance: Array,
        fit: Callable[[Array], float | None] | None = None,
    ) -> TagDecision:
        """Judge a fix against the estimate at its exposure.

        Args:
            fix: as read.
            pose: estimated x, y, yaw in world. Shape (3,).
            covariance: of the estimate. Shape (3, 3).
            fit: how well a scan fits if the vehicle was at a pose at the exposure (`Amcl.fit`).
                None, or if it answers None: nothing contradicts a tag beyond tau.
        """
        pose, covariance = np.array(pose, dtype=float), np.array(covariance, dtype=float)
        fault = self._fault(fix)
        if fault is not None:
            return TagDecision("refused", pose, covariance, fault)
        by_tag = fix.vehicle_pose(np.asarray(self._tags[fix.text.tag_id]))
        turn = np.eye(3)
        turn[:2, :2] = rot2(by_tag[2])
        sight = turn @ fix.covariance @ turn.T  # base axes to world
        off = by_tag - pose
        off[2] = wrap_angle(off[2])
        far = np.hypot(*off[:2]) > self._policy.tau or abs(off[2]) > self._policy.tau_yaw
        strange = off @ np.linalg.solve(covariance + sight, off) > GATE
        agreed = self._scan_agrees(by_tag, pose, fit) if far or strange else True
        if agreed is False:
            at = f"{np.hypot(*off[:2]):.3f} m and {np.degrees(off[2]):.1f} deg off"
            why = f"tag {fix.text.tag_id}: {at}, where the scan does not fit"
            return TagDecision("refused", pose, covariance, why)
        again = self._note(fix)
        if far or (strange and agreed):
            return self._keep(fix, TagDecision("reset", by_tag, sight))
        if again:
            return self._hold(fix, pose, covariance)
        gain = covariance @ np.linalg.inv(covariance + sight)
        fused = pose + gain @ off
        fused[2] = wrap_angle(fused[2])
        rest = np.eye(3) - gain
        after = rest @ covariance @ rest.T + gain @ sight @ gain.T
        return self._keep(fix, TagDecision("fused", fused, after))

    def _keep(self, fix: TagFix, decision: TagDecision) -> TagDecision:
        """Remember where the tag lies if the pose after its first sight is right."""
        self._lies = compose2(decision.pose, fix.pose_base_tag)
        self._first = decision.covariance
        return decision

    def _hold(self, fix: TagFix, pose: Array, covariance: Array) -> TagDecision:
        """A further sight of the same pass.

        It shares the error of the tag's placement with the first, so it tells nothing new of where
        the tag lies; but it tells to a fraction of a millimetre how the vehicle has moved since.
        What was known then holds still, if drift has not left more than that.
        """
        if np.trace(covariance[:2, :2]) <= np.trace(self._first[:2, :2]):
            return TagDecision("fused", pose, covariance)
        return TagDecision("fused", fix.vehicle_pose(self._lies), self._first.copy())

    def _fault(self, fix: TagFix) -> str | None:
        text, p = fix.text, self._policy
        if not (np.isfinite(fix.stamp) and np.all(np.isfinite(fix.pose_base_tag))):
            return f"tag {text.tag_id}: fix is not finite"
        if fix.stamp <= self._stamp:
            return f"tag {text.tag_id}: fix at {fix.stamp:.3f} s is not newer than the last"
        if text.tag_id not in self._tags:
            return f"tag {text.tag_id}: not in the survey"
        x, y, yaw = between2(self._tags[text.tag_id], text.pose)
        if np.hypot(x, y) > p.survey or abs(yaw) > p.survey_yaw:
            return f"tag {text.tag_id}: its text says {text.pose}, the survey otherwise"
        return None

    def _scan_agrees(self, by_tag: Array, pose: Array, fit) -> bool | None:
        """Whether the scan fits at the tag's pose about as well as at the estimate; None: no scan.

        A tag that lies off its place loses; a lost estimate does too, and so does one that stands
        in the wrong of several places that look alike, where both fit and the tag is believed.
        """
        there, here = (None, None) if fit is None else (fit(by_tag), fit(pose))
        if there is None or here is None:
            return None
        return bool(there >= self._policy.consent * here)

    def _note(self, fix: TagFix) -> bool:
        """Whether this is a further sight of the same pass."""
        again = fix.text.tag_id == self._last_id and fix.stamp - self._stamp < self._policy.forget
        self._stamp, self._last_id = fix.stamp, fix.text.tag_id
        return again
