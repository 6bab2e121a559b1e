"""What became of each kidnapping, from the plant's truth: found again, when, and wrong places."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.geometry import between2
from twin.loop import Tick

FOUND, FOUND_YAW = 0.3, float(np.radians(15.0))  # m, rad from truth: the issue's
HELD = 1.0  # s that the vehicle must stay found, and be sure of it
LIMIT = 60.0  # s within which it counts
WRONG, WRONG_TIME = 0.5, 5.0  # m off without taking itself for lost, for so long: a wrong place


@dataclass
class Episode:
    """One kidnapping."""

    began: float  # s
    pose: NDArray  # where the vehicle was put down. Shape (3,)
    alike: bool  # a place that looks like the one it was taken from
    found: float | None = None  # s at which it was found, and stayed so
    wrong: bool = False


class KidnapMonitor:
    """Follows the kidnappings that `kidnapped` tells it of."""

    def __init__(self):
        self.episodes: list[Episode] = []
        self.false_alarms = 0  # times that it took itself for lost and was not
        self._good_since: float | None = None
        self._wrong_since: float | None = None
        self._was_lost = True  # a run may begin lost: that is no alarm
        self.notes: list[str] = []

    def kidnapped(self, stamp: float, pose, alike: bool) -> None:
        self.episodes.append(Episode(stamp, np.array(pose), alike))
        self._good_since = self._wrong_since = None

    @property
    def searching(self) -> Episode | None:
        """The kidnapping from which the vehicle has not been found yet."""
        last = self.episodes[-1] if self.episodes else None
        return last if last is not None and last.found is None else None

    def observe(self, tick: Tick) -> None:
        now, state, episode = tick.stamp, tick.state, self.searching
        off = between2(tick.truth.pose, state.pose)
        distance, turn = float(np.hypot(*off[:2])), abs(float(off[2]))
        if state.lost and not self._was_lost and episode is None:
            self.false_alarms += 1
            self.notes.append(f"{now:.2f} s: lost without a kidnapping, {distance:.3f} m off")
        self._was_lost = state.lost
        if state.lost or distance <= WRONG:
            self._wrong_since = None
        elif self._wrong_since is None:
            self._wrong_since = now
        elif now - self._wrong_since > WRONG_TIME and self.episodes:
            self.episodes[-1].wrong = True
        if state.lost or distance > FOUND or turn > FOUND_YAW:
            self._good_since = None
        elif self._good_since is None:
            self._good_since = now
        elif episode is not None and now - self._good_since >= HELD:
            episode.found = self._good_since
            x, y, _ = episode.pose
            place = "a place that looks alike" if episode.alike else "anywhere"
            self.notes.append(
                f"{episode.began:.2f} s: carried to ({x:.2f}, {y:.2f}), {place}; found after "
                f"{episode.found - episode.began:.1f} s"
            )

    def metrics(self) -> dict[str, float]:
        """Figures of the report; times are of those that were found."""
        times = [e.found - e.began for e in self.episodes if e.found is not None]
        good = [t for t in times if t <= LIMIT]
        n = len(self.episodes)
        return {
            "kidnaps": float(n),
            "relocalised": len(good) / n if n else float("nan"),
            "relocalise_median_s": float(np.median(times)) if times else float("nan"),
            "relocalise_max_s": float(np.max(times)) if times else float("nan"),
            "wrong_places": float(sum(e.wrong for e in self.episodes)),
            "false_alarms": float(self.false_alarms),
        }
