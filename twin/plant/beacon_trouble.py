"""What goes wrong in the photoelectric network: blocked nodes, and nodes that see reflections."""

from dataclasses import dataclass

import numpy as np

from twin.geometry import Array
from twin.layout import BeaconFaults, Reflection

# Of an image from its node, m: a mirror within a few decimetres of it; guess
LEAST_SHIFT, SHIFT = 0.001, 0.4
HIDDEN, SHARE = 0.3, 0.8  # of the reflections that the lot draws; guess


@dataclass(frozen=True)
class Image:
    """Where light that a node sees seems to come to: itself, or its image in a mirror."""

    node: int
    place: Array  # (3,) in world, m
    direct: bool
    mirror: float = 0.0  # m before the place at which the mirror may stand


class BeaconTrouble:
    """The faults of a layout, from turn to turn of the head.

    Args:
        faults: of the layout.
        names: of the nodes.
        rng: draws which nodes are meant, where the layout leaves that open.
    """

    def __init__(self, faults: BeaconFaults, names: tuple[str, ...], rng: np.random.Generator):
        self._faults, self._names, self._rng = faults, names, rng
        self.blocked, self._mirrors = faults.blocked, faults.reflections
        self.reflections: tuple[Reflection, ...] = ()  # those that show in this turn
        self.begin(0)

    def begin(self, turn: int) -> None:
        """A turn of the head begins: what goes wrong in it.

        Args:
            turn: how many have begun before.
        """
        if self._faults.shuffle and turn % self._faults.shuffle == 0:
            self._draw()
        self.reflections = tuple(m for m in self._mirrors if self._shows(m.share))

    @property
    def dark(self) -> frozenset[str]:
        """Nodes to which no direct light comes."""
        return frozenset((*self.blocked, *(m.node for m in self._mirrors if m.hides)))

    def images(self, places: Array) -> list[Image]:
        """All that may be seen in this turn. `places`: the nodes in world, m. Shape (n, 3)."""
        lit = [i for i, name in enumerate(self._names) if name not in self.dark]
        direct = [Image(i, places[i], True) for i in lit]
        mirrored = [(self._names.index(r.node), r.shift) for r in self.reflections]
        size = np.linalg.norm
        return direct + [Image(i, places[i] + s, False, float(size(s))) for i, s in mirrored]

    def _shows(self, share: float) -> bool:
        return share >= 1.0 or bool(self._rng.random() < share)

    def _draw(self) -> None:
        """Another node is blocked, and another one reflects, of those that are sound otherwise."""
        rng, faults = self._rng, self._faults
        ill = {*faults.blocked, *(r.node for r in faults.reflections)}
        blocked, mirrored = rng.choice([n for n in self._names if n not in ill], 2, replace=False)
        self.blocked = (*faults.blocked, str(blocked))
        direction = rng.standard_normal(3)
        size = np.exp(rng.uniform(np.log(LEAST_SHIFT), np.log(SHIFT)))
        x, y, z = size * direction / np.linalg.norm(direction)
        drawn = Reflection(
            node=str(mirrored),
            shift=(float(x), float(y), float(z)),
            hides=bool(rng.random() < HIDDEN),
            share=SHARE,
        )
        self._mirrors = (*faults.reflections, drawn)
