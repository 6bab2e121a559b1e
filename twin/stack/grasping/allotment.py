"""Which arm takes which part: the best joint allotment over all free arms and reachable parts."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from twin.messages import PartClass


@dataclass(frozen=True)
class Candidate:
    """One way to take one part: this arm meets this track at this time."""

    arm: int
    track_id: int
    part_class: PartClass
    meet_time: float  # s on the run's clock


def allot(
    candidates: Sequence[Candidate], remaining: Mapping[PartClass, int]
) -> tuple[Candidate, ...]:
    """At most one candidate an arm, no track twice, no class beyond what is still wanted.

    As many arms as possible get work, and among those allotments the sum of the meeting times is
    least; so an arm never takes a part that the other alone could reach while it has another
    choice, and neither starves. Exhaustive: two arms and a belt's worth of parts are few.

    Args:
        candidates: what each free arm could do, any order.
        remaining: parts still wanted of each class, those in hand already taken off.
    """
    arms = sorted({c.arm for c in candidates})
    choices = [[None, *(c for c in candidates if c.arm == arm)] for arm in arms]
    best: tuple[Candidate, ...] = ()
    best_key = (0, 0.0)
    for pick in product(*choices):
        chosen = tuple(c for c in pick if c is not None)
        if len({c.track_id for c in chosen}) < len(chosen):
            continue
        wanted = Counter(c.part_class for c in chosen)
        if any(n > remaining.get(part_class, 0) for part_class, n in wanted.items()):
            continue
        key = (-len(chosen), sum(c.meet_time for c in chosen))
        if key < best_key:
            best, best_key = chosen, key
    return best
