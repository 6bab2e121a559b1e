"""The course: straight legs, strafes and turns on the spot, as drawn and at full speed."""

from typing import TYPE_CHECKING

from twin.messages import CourseOrder
from twin.stack.tasks.mission import Behaviour, sequence

if TYPE_CHECKING:
    from twin.stack.stack import Stack


def course_mission(stack: "Stack") -> Behaviour:
    """From way-point to way-point of the order, on the localised pose, with a stop at each."""
    order = stack.order
    assert isinstance(order, CourseOrder)
    return sequence("course", stack.straight("drive the course", *order.route))
