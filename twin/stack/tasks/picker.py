"""Fills the order from the belt: allots tracked parts to the arms and follows them."""

from collections import Counter

import numpy as np

from twin.geometry import inverse, pose2_to_transform
from twin.messages import Order, PartClass, TrackedPart
from twin.stack.config import StackConfig
from twin.stack.grasping.allotment import Candidate, allot
from twin.stack.grasping.tray import TrayBook
from twin.stack.tasks.arm_worker import ArmWorker, Job, Phase, grasp_of

ALLOT_PERIOD = 0.05  # s between allotments
REFINE_PERIOD = 0.05  # s between corrections of a plan under way
HORIZON = 3.5  # s ahead that a meeting is fixed; a later one might be the other arm's sooner
LEAST_HITS = 4  # frames that must have seen a part
LEAST_CONFIDENCE = 0.6  # below: look again rather than grab
PATIENCE = 90.0  # s without a wanted part after which the rest is given up


class Picker:
    """Coordinates the arms at the line.

    Args:
        config: the stack's belief.
        workers: the arms that work, at least one.
    """

    def __init__(self, config: StackConfig, workers: tuple[ArmWorker, ...]):
        self.config, self.workers = config, workers
        self.book = TrayBook(config, len(workers))
        self.order: Counter[PartClass] = Counter()
        self.tried: set[int] = set()  # tracks that were taken or missed once
        self.active = False
        self._next_allot = self._next_refine = self._last_progress = 0.0

    def start(self, now: float, order: Order) -> None:
        self.order = Counter(dict(order.items))
        self.active, self._last_progress = True, now

    def remaining(self) -> Counter[PartClass]:
        """Still wanted: ordered less placed less under way."""
        taken = Counter(j.part_class for w in self.workers for j in w.placed)
        taken.update(w.job.part_class for w in self.workers if w.job and not self._given_up(w))
        return Counter({c: n - taken[c] for c, n in self.order.items() if n > taken[c]})

    def finished(self, now: float) -> bool:
        """The order is filled, the tray is full, or nothing wanted has come for long."""
        if not all(w.free for w in self.workers):
            return False
        if not self.remaining() or not any(self.book.free(w.index) for w in self.workers):
            return True
        return now - self._last_progress > PATIENCE

    def step(self, now: float, pose, parts: tuple[TrackedPart, ...]) -> None:
        """Allot and refine.

        Args:
            now: s.
            pose: fused x, y, yaw of the vehicle, in the frame of the tracks.
            parts: tracks predicted to `now`.
        """
        self._collect_lost()
        if not self.active:
            return
        T_base_odom = inverse(pose2_to_transform(pose))
        if now >= self._next_refine:
            self._next_refine = now + REFINE_PERIOD
            by_id = {part.track_id: part for part in parts}
            for w in self.workers:
                if w.job and w.job.track_id in by_id:
                    w.refine(now, self._grasp(w, by_id[w.job.track_id], now, T_base_odom))
        if now >= self._next_allot and any(w.free for w in self.workers):
            self._next_allot = now + ALLOT_PERIOD
            self._allot(now, T_base_odom, parts)

    def _allot(self, now: float, T_base_odom, parts: tuple[TrackedPart, ...]) -> None:
        remaining = self.remaining()
        good = [
            p
            for p in parts
            if p.part_class in remaining
            and p.track_id not in self.tried
            and p.hits >= LEAST_HITS
            and p.confidence >= LEAST_CONFIDENCE
        ]
        candidates, grasps = [], {}
        for w in self.workers:
            if not w.free or not self.book.free(w.index):
                continue
            for p in good:
                grasp = self._grasp(w, p, now, T_base_odom)
                meet = w.earliest(now, grasp)
                if meet is not None and meet - now < HORIZON:
                    candidates.append(Candidate(w.index, p.track_id, p.part_class, meet))
                    grasps[w.index, p.track_id] = grasp
        by_arm = {w.index: w for w in self.workers}
        for c in allot(candidates, remaining):
            slot = self.book.take(c.arm)
            job = Job(c.track_id, c.part_class, slot, c.meet_time)
            if by_arm[c.arm].take(now, job, grasps[c.arm, c.track_id]):
                self.tried.add(c.track_id)
                self._last_progress = now
            else:
                self.book.give_back(c.arm, slot)
        busy = {c.arm for c in candidates}
        for w in self.workers:
            # With nothing in sight: back over the belt, if it is not there already.
            if w.free and w.index not in busy and w.motion.idle(now):
                away = np.linalg.norm(w.motion.tcp(now) - w.motion.ready_position)
                if away > 0.05 and remaining:
                    w.motion.go_ready(now)

    def _grasp(self, worker: ArmWorker, part: TrackedPart, now: float, T_base_odom):
        return grasp_of(part, now, self.config, worker.motion.T_mount_base @ T_base_odom)

    def _collect_lost(self) -> None:
        for w in self.workers:
            while w.lost:
                self.book.give_back(w.index, w.lost.pop().slot)

    @staticmethod
    def _given_up(worker: ArmWorker) -> bool:
        return worker.phase in (Phase.GIVING_UP, Phase.BLOCKED)
