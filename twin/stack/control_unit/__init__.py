"""The vehicle's 500 Hz controller: encoder counts in, PWM out.

It exchanges two messages with the rest of the stack, `BodyVelocity` and `WheelState`: a CAN bus
stands between them (Li & An 2025, section 1.2, Fig. 2).
"""

from twin.stack.control_unit.control_unit import PERIOD, ControlUnit

__all__ = ["PERIOD", "ControlUnit"]
