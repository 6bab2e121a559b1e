"""Poses against truth: the outline inside each box, fitted, at the height from which parts are
picked."""

from dataclasses import replace

import numpy as np

from twin.geometry import between2, wrap_angle
from twin.messages import CameraFrame, Detection
from twin.stack.config import StackConfig
from twin.stack.detection.network import Network
from twin.stack.detection.network_detector import NetworkDetector

NEAR = 0.02  # m: a detection farther from every part is of none of them


def pose_figures(pictures, config: StackConfig, network: Network) -> dict[str, float]:
    """Errors of detections of the right class at pick height, glare left out and alone.

    Args:
        pictures: a labelled set, each picture with its own camera as calibrated.
        config: the drawing.
        network: trained.
    """
    errors: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    wanted = {False: 0, True: 0}
    for k, shot in enumerate(pictures.shots):
        c = shot.condition
        if c.height != "pick" or c.angle != "drawn":
            continue
        glare = c.light == "glare"
        image = pictures.image(k)
        detector = NetworkDetector(replace(config, camera=shot.camera), network)
        pose = np.array(shot.pose)
        truths = [
            (label.part_class, between2(pose, label.pose))
            for label in shot.labels
            if label.visible > 0.95
        ]
        wanted[glare] += len(truths)
        for d in detector.detect(CameraFrame(0.0, image), pose):
            error = _error(d, truths)
            if error is not None:
                errors[glare].append(error)
    out = {}
    for glare, suffix in ((False, ""), (True, "_glare")):
        apart, axis = np.array(errors[glare] or [(np.nan, np.nan)]).T
        out |= {
            f"poses{suffix}": float(len(errors[glare])),
            f"centroid_error_p95_mm{suffix}": 1e3 * float(np.percentile(apart, 95)),
            f"axis_error_p95_deg{suffix}": float(np.degrees(np.percentile(axis, 95))),
        }
    return out


def _error(d: Detection, truths) -> tuple[float, float] | None:
    """Distance, m, and angle, rad, from the part that a detection is of; None if it is of none."""
    same = [p for c, p in truths if c == d.part_class]
    if not same:
        return None
    pose = min(same, key=lambda p: np.hypot(p[0] - d.p_base[0], p[1] - d.p_base[1]))
    apart = float(np.hypot(pose[0] - d.p_base[0], pose[1] - d.p_base[1]))
    if apart > NEAR:
        return None
    angle = abs(float(wrap_angle(d.yaw - pose[2])))
    return apart, min(angle, np.pi - angle) if d.symmetric else angle
