"""How well the vehicle knew where it was, against the plant's truth.

Aisles are the racks' bounding box and the cross aisles around it. A pose error at a tag is that of
the pose believed at the exposure after the tag was taken in, against the true pose at that instant.
"""

import numpy as np
from numpy.typing import NDArray

from evaluation.ape import PoseErrors
from evaluation.trajectories import MOVING
from twin.floor_plan import machines
from twin.geometry import wrap_angle
from twin.loop import Tick
from twin.site import Site

AROUND = 1.5  # m of aisle around the racks
OVER_TAG = 0.08  # m from the vehicle's middle within which the camera sees a tag whole
SETTLING = 5.0  # s after the vehicle has found itself before its particles count as settled


class LocalisationMonitor:
    """Follows truth and belief tick by tick; `metrics()` at the end.

    Args:
        site: the drawing, for aisles and tags.
    """

    def __init__(self, site: Site):
        boxes = [b for name, b in machines(site).items() if name.startswith("rack ")]
        corners = np.array([corner for box in boxes for b in box for corner in b])
        self._zone = None
        if len(corners):
            self._zone = corners.min(axis=0) - AROUND, corners.max(axis=0) + AROUND
        self._tags = np.array([tag.pose[:2] for tag in site.tags]).reshape(-1, 2)
        self._stamps: list[float] = []
        self._truth: list[NDArray] = []
        self._belief: list[NDArray] = []
        self._moving: list[bool] = []
        self._lost: list[bool] = []
        self._particles: list[int] = []
        self._sights: list[tuple[float, NDArray]] = []  # exposure, pose believed
        self.refused = 0

    def observe(self, tick: Tick) -> None:
        state, truth = tick.state, tick.truth
        self._stamps.append(tick.stamp)
        self._truth.append(np.array(truth.pose))
        self._belief.append(np.array(state.pose))
        self._moving.append(bool(np.any(np.abs(truth.velocity) > MOVING)))
        self._lost.append(state.lost)
        self._particles.append(state.particles)
        for sight in state.sights:
            if sight.action == "refused":
                self.refused += 1
            else:
                self._sights.append((sight.stamp, np.array(sight.pose)))

    # --- series ----------------------------------------------------------------------------------

    @property
    def stamps(self) -> NDArray:
        """Of the ticks, s. Shape (n,)."""
        return np.array(self._stamps)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Whether the vehicle took itself for lost. Shape (n,)."""
        return np.array(self._lost, dtype=bool)

    def errors(self) -> PoseErrors:
        """Of the pose believed at each tick."""
        off = np.array(self._belief).reshape(-1, 3) - np.array(self._truth).reshape(-1, 3)
        return PoseErrors(self.stamps, np.hypot(off[:, 0], off[:, 1]), wrap_angle(off[:, 2]))

    def in_aisles(self) -> NDArray[np.bool_]:
        """Whether the vehicle moved, in truth and in an aisle. Shape (n,)."""
        moving = np.array(self._moving, dtype=bool)
        if self._zone is None:
            return np.zeros(len(moving), dtype=bool)
        xy = np.array(self._truth).reshape(-1, 3)[:, :2]
        low, high = self._zone
        return moving & np.all((xy > low) & (xy < high), axis=1)

    def at_sights(self) -> NDArray:
        """Position error right after each tag that was read and believed, m. Shape (k,)."""
        if not self._sights:
            return np.zeros(0)
        t, truth = self.stamps, np.array(self._truth)
        when = np.array([stamp for stamp, _ in self._sights])
        true = np.column_stack([np.interp(when, t, truth[:, i]) for i in range(2)])
        return np.hypot(*(np.array([pose[:2] for _, pose in self._sights]) - true).T)

    def over_tags(self) -> NDArray:
        """Position error while the vehicle truly stands over a tag, read or not, m. Shape (k,)."""
        xy = np.array(self._truth).reshape(-1, 3)[:, :2]
        if len(xy) == 0 or len(self._tags) == 0:
            return np.zeros(0)
        near = np.zeros(len(xy), dtype=bool)
        for tag in self._tags:
            near |= np.hypot(*(xy - tag).T) < OVER_TAG
        return self.errors().translation[near]

    def particle_ratio(self) -> float:
        """Particles when nothing was known over those of a settled filter; NaN without either.

        Nothing is known at a global start or after a kidnapping: the most particles at any tick
        that is lost. A run that starts at its dock and is never lost has no such start.
        """
        lost, particles = self.lost, np.array(self._particles)
        if not lost.any():
            return float("nan")
        stamps = self.stamps
        last_lost = np.maximum.accumulate(np.where(lost, stamps, -np.inf))
        settled = ~lost & (stamps > last_lost + SETTLING) & np.array(self._moving, dtype=bool)
        if not settled.any():
            return float("nan")
        return float(particles[lost].max() / np.median(particles[settled]))

    # --- figures ---------------------------------------------------------------------------------

    def metrics(self) -> dict[str, float]:
        """Figures for the report; NaN for what did not occur.

        ape_rmse_m, ape_max_m, ape_yaw_rmse_deg: of all ticks; ape_aisle_rmse_m, ape_aisle_max_m:
        in the aisles while moving; qr_pose_error_p95_mm: right after a tag was taken in;
        over_tags_error_p95_mm: over a tag whether it was read or not, to compare with a run
        without tags.
        """
        errors = self.errors()
        aisle = errors.where(self.in_aisles())
        return {
            "ape_rmse_m": errors.rmse,
            "ape_max_m": errors.maximum,
            "ape_yaw_rmse_deg": errors.yaw_rmse_deg,
            "ape_aisle_rmse_m": aisle.rmse,
            "ape_aisle_max_m": aisle.maximum,
            "qr_pose_error_p95_mm": _p95_mm(self.at_sights()),
            "over_tags_error_p95_mm": _p95_mm(self.over_tags()),
            "tags_read": float(len(self._sights)),
            "tags_refused": float(self.refused),
        }


def _p95_mm(errors: NDArray) -> float:
    return float(1e3 * np.percentile(errors, 95)) if len(errors) else float("nan")
