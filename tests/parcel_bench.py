"""A vehicle beside goods-in: its camera, its front arm and a parcel, in the real plant."""

import numpy as np

from twin.geometry import Array, between2, compose2
from twin.layout import load_layout
from twin.messages import ArmReading, CameraFrame, Commands, GripperReading, TransportOrder
from twin.plant.plant import STEPS_PER_TICK, Plant
from twin.stack.config import nominal_config
from twin.stack.tasks.arm_worker import ArmWorker
from twin.stack.tasks.porter import Place, Porter

PARCEL = "part_parcel_0"


class ParcelBench:
    """The dock lies at goods-in, `back` m behind; the wheels stand."""

    def __init__(self, seed: int, back: float = 0.0, *overrides: str):
        layout = load_layout(overrides=overrides)
        dock = compose2(layout.site.goods_in, (-back, 0.0, 0.0))
        site = layout.site.model_copy(update={"dock": tuple(dock)})
        self.layout = layout.model_copy(update={"site": site})
        self.config = nominal_config(self.layout.site, self.layout.options)
        self.plant = Plant(self.layout, seed, TransportOrder(0.0))
        self.workers = [ArmWorker(i, self.config) for i in range(2)]
        self.plant.park([w.motion.rest for w in self.workers])
        self.porter = Porter(self.workers[0])
        self.pictures: list[CameraFrame] = []
        self.tick = 0

    @property
    def now(self) -> float:
        return 0.010 * self.tick

    def parcel_in_base(self) -> tuple[Array, float]:
        """True x, y, yaw of the parcel in base, and the height of its bottom."""
        truth = self.plant.truth()
        T = truth.T_world_part(PARCEL)
        pose = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
        return between2(truth.pose, pose), float(T[2, 3])

    def place(self) -> Place:
        """Where the parcel truly stands."""
        (x, y, yaw), z = self.parcel_in_base()
        return Place((x, y, z), yaw)

    def step(self, picture: bool = False) -> None:
        for reading in self.plant.readings():
            if isinstance(reading, ArmReading | GripperReading):
                self.workers[reading.arm].hear(reading)
            elif isinstance(reading, CameraFrame):
                self.pictures.append(reading)
        self.porter.step(self.now)
        arms, grippers = zip(*(w.step(self.now) for w in self.workers), strict=True)
        self.plant.apply(Commands(arms=arms, grippers=grippers, mast_camera=picture))
        for _ in range(STEPS_PER_TICK):
            self.plant.step(np.zeros(4))
        self.tick += 1

    def carry(self, source: Place, goal: Place, longest: float = 15.0) -> None:
        self.porter.start(self.now, source, goal)
        until = self.now + longest
        while not self.porter.idle and self.now < until:
            self.step()

    def close(self) -> None:
        self.plant.close()
