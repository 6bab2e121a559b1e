"""What a scenario is asked for and what it hands back."""

import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Trajectory = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Stamps, shape (n,), s; poses in world, shape (n, 3) as x, y, yaw or (n, 7) as x, y, z, qw..qz."""

OPERATORS = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
    "==": operator.eq,
}


def no_progress(sim_time: float, total: float, text: str) -> None:
    """Stands in where nobody watches."""


@dataclass(frozen=True)
class RunRequest:
    """One run, as asked for on the command line.

    Attributes:
        seed: of the run's one random generator.
        out: folder that receives the scenario's own files, `recording.rrd` among them.
        duration: simulated seconds after which the run is cut short; None runs to its end.
        record: whether to write `recording.rrd` for the viewer.
        log: whether to write `readings.log` for replay.
        viewer: whether to open MuJoCo's viewer.
        progress: called now and then with simulated time, expected total (s) and a short text.
    """

    seed: int
    out: Path
    duration: float | None = None
    record: bool = False
    log: bool = False
    viewer: bool = False
    progress: Callable[[float, float, str], None] = no_progress


@dataclass(frozen=True)
class Criterion:
    """A limit on one metric: `metric op limit` must hold."""

    name: str
    op: str
    limit: float

    def __post_init__(self):
        if self.op not in OPERATORS:
            raise ValueError(f"criterion {self.name}: op '{self.op}' is not of {list(OPERATORS)}")

    def passed(self, value: float) -> bool:
        """Whether it holds; what could not be measured (NaN) never does."""
        return bool(OPERATORS[self.op](value, self.limit))


@dataclass(frozen=True)
class RunResult:
    """What came of a run.

    Attributes:
        metrics: by name, in the order of the table; NaN for what could not be measured.
        criteria: limits on some of them.
        sim_time: simulated, s.
        wall_time: of the loop, s.
        rtf: simulated over wall time of the loop after its warm-up.
        complete: whether the scenario came to its own end; False if cut short.
        trajectories: written as `<name>.tum`.
        notes: one line each, for the reader of the report.
    """

    metrics: dict[str, float] = field(default_factory=dict)
    criteria: list[Criterion] = field(default_factory=list)
    sim_time: float = 0.0
    wall_time: float = 0.0
    rtf: float = float("nan")
    complete: bool = False
    trajectories: dict[str, Trajectory] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
