"""Leaves and joints of the behaviour trees (Li & An 2025, Fig. 6, is one of them)."""

from collections.abc import Callable

import py_trees
from py_trees.common import ParallelPolicy, Status

Behaviour = py_trees.behaviour.Behaviour
Check = Callable[[], bool]
Start = Callable[[], object]


class Act(Behaviour):
    """A leaf that calls `start` once on entry and is running until `done` or `failed` holds."""

    def __init__(
        self, name: str, done: Check, start: Start | None = None, failed: Check = lambda: False
    ):
        super().__init__(name)
        self._done, self._start, self._failed = done, start, failed

    def initialise(self) -> None:
        if self._start is not None:
            self._start()

    def update(self) -> Status:
        if self._failed():
            return Status.FAILURE
        return Status.SUCCESS if self._done() else Status.RUNNING


def sequence(name: str, *children: Behaviour) -> py_trees.composites.Sequence:
    """One after the other; a finished child is not asked again. Fails with its first failure."""
    return py_trees.composites.Sequence(name, memory=True, children=list(children))


def together(name: str, *children: Behaviour) -> py_trees.composites.Parallel:
    """All at once; done when every child is done, failed when one has failed."""
    policy = ParallelPolicy.SuccessOnAll(synchronise=True)
    return py_trees.composites.Parallel(name, policy=policy, children=list(children))


def running(root: Behaviour) -> str:
    """Names of the running leaves, for the record."""
    leaves = [b.name for b in root.iterate() if not b.children and b.status is Status.RUNNING]
    return " + ".join(leaves) if leaves else root.status.value.lower()


def end(root: Behaviour) -> None:
    """Give the whole tree up."""
    root.stop(Status.FAILURE)


def gave_up(root: Behaviour) -> str:
    """Name of the leaf with which a tree failed; empty if it did not."""
    if root.status is not Status.FAILURE:
        return ""
    failed = [b.name for b in root.iterate() if not b.children and b.status is Status.FAILURE]
    return failed[0] if failed else root.name


def ended(root: Behaviour) -> bool:
    """Whether the tree has come to its end, well or not."""
    return root.status in (Status.SUCCESS, Status.FAILURE)
