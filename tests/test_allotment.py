"""Allotment of parts to arms."""

from itertools import product

from hypothesis import given
from hypothesis import strategies as st

from twin.messages import PART_CLASSES
from twin.stack.grasping.allotment import Candidate, allot

candidates = st.lists(
    st.builds(
        Candidate,
        arm=st.integers(0, 1),
        track_id=st.integers(0, 4),
        part_class=st.sampled_from(PART_CLASSES[:2]),
        meet_time=st.floats(0, 10),
    ),
    max_size=8,
)


def test_an_arm_leaves_the_part_that_only_the_other_can_reach():
    """Expected result: arm 0 takes the later part, since arm 1 reaches only the early one."""
    c = PART_CLASSES[0]
    found = allot(
        [Candidate(0, 1, c, 1.0), Candidate(0, 2, c, 2.0), Candidate(1, 1, c, 1.5)], {c: 5}
    )
    assert {(x.arm, x.track_id) for x in found} == {(0, 2), (1, 1)}


def test_the_last_wanted_part_goes_to_the_earlier_arm():
    c = PART_CLASSES[0]
    found = allot([Candidate(0, 1, c, 3.0), Candidate(1, 2, c, 2.0)], {c: 1})
    assert [x.arm for x in found] == [1]


def test_nothing_is_taken_that_is_not_wanted():
    assert allot([Candidate(0, 1, PART_CLASSES[0], 1.0)], {PART_CLASSES[1]: 3}) == ()


@given(candidates, st.integers(0, 2))
def test_allotment_is_valid_and_as_large_as_any(found, wanted):
    remaining = {c: wanted for c in PART_CLASSES}
    chosen = allot(found, remaining)
    assert len({c.track_id for c in chosen}) == len({c.arm for c in chosen}) == len(chosen)
    assert all(sum(x.part_class == c for x in chosen) <= wanted for c in PART_CLASSES)
    pairs = product([c for c in found if c.arm == 0], [c for c in found if c.arm == 1])
    two = any(
        a.track_id != b.track_id and (wanted >= 2 or (wanted == 1 and a.part_class != b.part_class))
        for a, b in pairs
    )
    assert len(chosen) == (2 if two else 1 if found and wanted else 0)
