"""The drive order: to one goal after the other, by the map."""

from typing import TYPE_CHECKING

from twin.messages import DriveOrder, Goal
from twin.stack.tasks.mission import Act, Behaviour, sequence

if TYPE_CHECKING:
    from twin.stack.stack import Stack


def drive_mission(stack: "Stack") -> Behaviour:
    """All goals of `stack.order`; one that is refused or given up is left out."""
    assert isinstance(stack.order, DriveOrder)
    return sequence("drive order", *[visit(stack, goal) for goal in stack.order.goals])


def visit(stack: "Stack", goal: Goal) -> Act:
    """To a goal; done however it ends: the navigator keeps the outcome."""
    navigator = stack.navigator
    return Act(
        f"drive to {goal.name}",
        done=lambda: not navigator.active,
        start=lambda: navigator.go(stack.now, goal),
    )
