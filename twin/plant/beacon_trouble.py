"""What goes wrong in the photoelectric network: blocked nodes, and nodes that see reflections."""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array
from twin.layout import BeaconFaults, Reflection

# Of an image from its node, m: a mirror within a few decimetres of it; guess
SHIFT = 0.4
LEAST_SHIFT = 0.01
HIDDEN, SHARE = 0.3, 0.8  # of the reflections that the lot draws; guess


@dataclass(frozen=True)
class Image:
    """Where light that a node sees seems to come to: itself, or its image in a mirror."""

    node: int
    place: Array  # (3,) in world, m
    direct: bool  # needs a line of sight


class BeaconTrouble:
    """The faults of a layout over time.

    Args:
        faults: of the layout.
        names: of the nodes.
        rng: draws which nodes are meant, where the layout leaves that open.
    """

    def __init__(self, faults: BeaconFaults, names: tuple[str, ...], rng: np.random.Generator):
        self._faults, self._names, self._rng = faults, names, rng
        self.blocked, self.reflections = faults.blocked, faults.reflections
        self._drawn = 0  # times that the lot was drawn
        self._tenth = -1  # of a second since the start
        self._shown: dict[str, bool] = {}  # by node, whether its reflection shows in it

    def images(self, time: float, places: Array) -> list[Image]:
        """All that may be seen now. `places`: the nodes in world, m. Shape (n, 3)."""
        if self._faults.shuffle and time >= self._drawn * self._faults.shuffle:
            self._draw()
        blocked = {self._names.index(name) for name in self.blocked}
        found = []
        for reflection in self.reflections:
            node = self._names.index(reflection.node)
            if reflection.hides:
                blocked.add(node)
            if self._shows(time, reflection):
                found.append(Image(node, places[node] + reflection.shift, False))
        direct = [Image(i, p, True) for i, p in enumerate(places) if i not in blocked]
        return direct + found

    def _shows(self, time: float, reflection: Reflection) -> bool:
        """Whether it is there in this tenth of a second: a mirror trembles."""
        if reflection.share >= 1.0:
            return True
        tenth = int(10 * time)
        if tenth != self._tenth:
            self._tenth, self._shown = tenth, {}
        if reflection.node not in self._shown:
            self._shown[reflection.node] = bool(self._rng.random() < reflection.share)
        return self._shown[reflection.node]

    def _draw(self) -> None:
        """Another node is blocked, and another one reflects."""
        rng = self._rng
        self._drawn += 1
        self._shown = {}
        blocked, mirrored = rng.choice(len(self._names), 2, replace=False)
        self.blocked = (*self._faults.blocked, self._names[blocked])
        direction = rng.standard_normal(3)
        size = np.exp(rng.uniform(np.log(LEAST_SHIFT), np.log(SHIFT)))
        x, y, z = size * direction / np.linalg.norm(direction)
        drawn = Reflection(
            node=self._names[mirrored],
            shift=(float(x), float(y), float(z)),
            hides=bool(rng.random() < HIDDEN),
            share=SHARE,
        )
        self.reflections = (*self._faults.reflections, drawn)
