"""The behaviour tree: fetch the order, drive to the line, pick, deliver (Li & An 2025, Fig. 6)."""

from collections.abc import Callable

import py_trees
from py_trees.common import ParallelPolicy, Status

Check = Callable[[], bool]
Start = Callable[[], object]


class Act(py_trees.behaviour.Behaviour):
    """A leaf that calls `start` once on entry and is running until `done` holds."""

    def __init__(self, name: str, done: Check, start: Start | None = None):
        super().__init__(name)
        self._done, self._start = done, start

    def initialise(self) -> None:
        if self._start is not None:
            self._start()

    def update(self) -> Status:
        return Status.SUCCESS if self._done() else Status.RUNNING


def sequence(name: str, *children: py_trees.behaviour.Behaviour) -> py_trees.composites.Sequence:
    """One after the other; a finished child is not asked again."""
    return py_trees.composites.Sequence(name, memory=True, children=list(children))


def together(name: str, *children: py_trees.behaviour.Behaviour) -> py_trees.composites.Parallel:
    """All at once; done when every child is done."""
    policy = ParallelPolicy.SuccessOnAll(synchronise=True)
    return py_trees.composites.Parallel(name, policy=policy, children=list(children))


def running(root: py_trees.behaviour.Behaviour) -> str:
    """Names of the running leaves, for the record."""
    leaves = [b.name for b in root.iterate() if not b.children and b.status is Status.RUNNING]
    return " + ".join(leaves) if leaves else root.status.value.lower()
