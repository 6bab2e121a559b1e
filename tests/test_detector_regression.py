"""The shipped network on a few stored pictures: no worse than when it was shipped."""

import pytest
from detector_frames import judge

from evaluation.detection import average_precision, count
from twin.stack.detection.network import Network


@pytest.fixture(scope="module")
def judged():
    return judge(Network())


def test_parts_are_found_and_named(judged):
    counts = count(judged, Network().card.threshold)
    total = sum(c.total for c in counts.classes)
    assert total > 30
    assert sum(c.right for c in counts.classes) / total >= 0.94
    assert average_precision(judged) >= 0.95
