"""Small statistics that say NaN, not an exception, where there is nothing to tell."""

from collections.abc import Sequence

import numpy as np


def percentile(values: Sequence[float], q: float) -> float:
    """The q-th percentile (0 to 100), linear between samples; NaN of nothing."""
    return float(np.percentile(values, q)) if len(values) else float("nan")


def ratio(part: float, whole: float) -> float:
    """`part / whole`; NaN if the whole is zero or not a number."""
    return part / whole if whole else float("nan")


def per_hour(count: float, seconds: float) -> float:
    """Rate of `count` events in `seconds`; NaN if no time has passed."""
    return 3600.0 * count / seconds if seconds > 0 else float("nan")
