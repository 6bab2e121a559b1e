"""Bookkeeping of the tray's slots."""

import numpy as np
import pytest

from twin.layout import load_layout
from twin.stack.config import nominal_config
from twin.stack.grasping.tray import TrayBook


@pytest.fixture(scope="module")
def config():
    layout = load_layout()
    return nominal_config(layout.site, layout.options)


def test_two_arms_share_the_slots_without_crossing_the_midplane(config):
    book = TrayBook(config, arms=2)
    mine = [book.take(0) for _ in range(book.free(0))]
    yours = [book.take(1) for _ in range(book.free(1))]
    assert len(mine) + len(yours) == len(config.tray.slots())
    assert min(s[0] for s in mine) > config.midplane > max(s[0] for s in yours)


def test_one_arm_fills_its_own_side_then_the_other_but_for_the_parked_hand(config):
    book = TrayBook(config, arms=1)
    taken = np.array([book.take(0) for _ in range(book.free(0))])
    assert len(np.unique(taken, axis=0)) == len(taken)
    own = len(config.tray.slots()) // 2
    assert (taken[:own, 0] > config.midplane).all()
    assert 20 <= len(taken) < len(config.tray.slots())
    with pytest.raises(IndexError):
        book.take(0)


def test_a_slot_given_back_is_next(config):
    book = TrayBook(config, arms=2)
    slot = book.take(1)
    book.take(1)
    book.give_back(1, slot)
    assert np.allclose(book.take(1), slot)
