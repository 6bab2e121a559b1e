"""Pictures of parts on the belt with labels. Run as a script to write tests/data/belt anew."""

import json
from pathlib import Path

import cv2
import mujoco
import numpy as np

from twin.geometry import Array, apply, inverse, rot2, rotation_from_quat, wrap_angle
from twin.layout import Layout, load_layout
from twin.messages import CameraFrame
from twin.plant.as_built import AsBuilt
from twin.plant.feeder import class_of
from twin.plant.sensors.camera import MastCamera
from twin.plant.sensors.rendering import RenderWorker
from twin.plant.world import World

FOLDER = Path(__file__).parent / "data" / "belt"
EXACT = (
    "world.tolerances.scale=0",
    "world.tolerances.dock_xy=0",
    "world.tolerances.dock_yaw_deg=0",
)
SPACING = 0.10  # m between the parts of a picture
Label = tuple[str, float, float, float]  # class, x, y in base, yaw in base


class BeltStudio:
    """Renders random scenes at the pick pose. The vehicle is exactly as drawn."""

    def __init__(self, seed: int):
        self.layout: Layout = load_layout(overrides=EXACT)
        self._rng = np.random.default_rng(seed)
        as_built = AsBuilt.draw(self._rng, self.layout.world.tolerances)
        self.world = World(self.layout, as_built, pool=2)
        self.worker = RenderWorker(self.world.model)
        self.camera = MastCamera(self.worker, self._rng)
        self.camera.on = True

    def close(self) -> None:
        self.worker.close()

    def shoot(self) -> tuple[CameraFrame, Array, list[Label]]:
        """One picture, the vehicle's true pose, and the labels of all parts on the belt."""
        rng, world, line = self._rng, self.world, self.layout.site.line
        pose = np.array(self.layout.site.pick) + rng.normal(0, (0.01, 0.005, 0.01))
        q = int(world.model.joint("agv/base").qposadr[0])
        world.data.qpos[q : q + 2] = pose[:2]
        world.data.qpos[q + 3 : q + 7] = (np.cos(pose[2] / 2), 0, 0, np.sin(pose[2] / 2))
        along = rot2(line.direction)
        for i, name in enumerate(rng.permutation(world.part_names)):
            offset = (0.45 + SPACING * i + rng.uniform(0, 0.04), rng.uniform(-0.04, 0.04))
            xy = np.asarray(line.origin) + along @ offset
            yaw = rng.uniform(-np.pi, np.pi)
            quat = (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
            # resting: sunk in by the softness of the contact
            world.place_part(str(name), (*xy, line.height - 0.0001), quat)
        mujoco.mj_forward(world.model, world.data)
        frame = self.camera.sample(world.time, world.model, world.data).result()
        truth = world.truth()
        T_base_world = inverse(truth.T_world_base)
        labels: list[Label] = []
        for name, p_world, quat in zip(
            truth.part_names, truth.part_position, truth.part_quat, strict=True
        ):
            x, y, _ = apply(T_base_world, p_world)
            R = T_base_world[:3, :3] @ rotation_from_quat(quat)
            labels.append((class_of(name), float(x), float(y), float(np.arctan2(R[1, 0], R[0, 0]))))
        return frame, truth.pose, labels


def errors(detections, labels: list[Label]) -> list[tuple[bool, float, float, float]]:
    """Per detection: class right, centroid error (m), axis error (rad), x in base."""
    out = []
    for d in detections:
        label = min(labels, key=lambda p: np.hypot(p[1] - d.p_base[0], p[2] - d.p_base[1]))
        distance = float(np.hypot(label[1] - d.p_base[0], label[2] - d.p_base[1]))
        angle = float(abs(wrap_angle(d.yaw - label[3])))
        out.append((d.part_class == label[0], distance, angle, label[1]))
    return out


def load() -> list[tuple[CameraFrame, Array, list[Label]]]:
    """The committed pictures."""
    entries = json.loads((FOLDER / "labels.json").read_text())
    frames = []
    for entry in entries:
        image = cv2.cvtColor(cv2.imread(str(FOLDER / entry["file"])), cv2.COLOR_BGR2RGB)
        labels = [tuple(p) for p in entry["parts"]]
        frames.append((CameraFrame(0.0, image), np.array(entry["pose"]), labels))
    return frames


def write(count: int = 12) -> None:
    """Render and store pictures with their labels."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    studio = BeltStudio(seed=7)
    entries = []
    for k in range(count):
        frame, pose, labels = studio.shoot()
        file = f"{k:02d}.jpg"
        bgr = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(FOLDER / file), bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])
        parts = [(c, round(x, 5), round(y, 5), round(a, 4)) for c, x, y, a in labels]
        entries.append({"file": file, "pose": [round(float(v), 6) for v in pose], "parts": parts})
    studio.close()
    text = ",\n".join(json.dumps(entry) for entry in entries)
    (FOLDER / "labels.json").write_text(f"[\n{text}\n]\n")


if __name__ == "__main__":
    write()
