"""Poses against truth: the outline inside each box, fitted, at the height from which parts are
picked."""

from dataclasses import replace

import numpy as np

from evaluation.pictures import PictureSet
from twin.geometry import between2, wrap_angle
from twin.messages import CameraFrame, Detection
from twin.stack.config import StackConfig
from twin.stack.detection.network import Network
from twin.stack.detection.network_detector import NetworkDetector

NEAR = 0.02  # m: a detection farther from every part is of none of them
CLOSE = 0.60  # m in base x, where a pixel is 1.3 mm of belt; 1.9 mm at the far end of the window


def pose_figures(pictures: PictureSet, config: StackConfig, network: Network) -> dict[str, float]:
    """Errors of detections of the right class at pick height, glare apart from other light.

    Args:
        pictures: a labelled set, each picture with its own camera as calibrated.
        config: the drawing.
        network: trained.
    """
    errors: dict[bool, list[tuple[float, float, float]]] = {False: [], True: []}
    for k, shot in enumerate(pictures.shots):
        c = shot.condition
        if c.height != "pick" or c.angle != "drawn":
            continue
        pose = np.array(shot.pose)
        truths = [
            (label.part_class, between2(pose, label.pose))
            for label in shot.labels
            if label.visible > 0.95
        ]
        detector = NetworkDetector(replace(config, camera=shot.camera), network)
        for d in detector.detect(CameraFrame(0.0, pictures.image(k)), pose):
            error = _error(d, truths)
            if error is not None:
                errors[c.light == "glare"].append(error)
    nothing = [(np.nan, np.nan, 0.0)]
    calm, glare = (np.array(errors[g] or nothing) for g in (False, True))
    out = {}
    for suffix, seen in (
        ("", calm[calm[:, 2] < CLOSE]),
        ("_window", calm),
        ("_glare", glare[glare[:, 2] < CLOSE]),
    ):
        seen = seen if len(seen) else np.array(nothing)
        out |= {
            f"poses{suffix}": float(np.isfinite(seen[:, 0]).sum()),
            f"centroid_error_p95_mm{suffix}": 1e3 * float(np.percentile(seen[:, 0], 95)),
            f"axis_error_p95_deg{suffix}": float(np.degrees(np.percentile(seen[:, 1], 95))),
        }
    return out


def _error(d: Detection, truths) -> tuple[float, float, float] | None:
    """Distance, m, angle, rad, and base x, m, of the part that a detection is of, if of any."""
    same = [p for c, p in truths if c == d.part_class]
    if not same:
        return None
    pose = min(same, key=lambda p: np.hypot(p[0] - d.p_base[0], p[1] - d.p_base[1]))
    apart = float(np.hypot(pose[0] - d.p_base[0], pose[1] - d.p_base[1]))
    if apart > NEAR:
        return None
    angle = abs(float(wrap_angle(d.yaw - pose[2])))
    return apart, min(angle, np.pi - angle) if d.symmetric else angle, float(pose[0])
