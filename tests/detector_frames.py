"""Pictures as the network gets them, with labels. Run as a script to write tests/data/detector."""

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

from evaluation.detection import Judged
from evaluation.judging import FAINT, judge_pictures
from evaluation.pictures import PictureSet, region_of
from twin.layout import load_layout
from twin.messages import PART_CLASSES
from twin.stack.config import nominal_config
from twin.stack.detection.boxes import read_maps
from twin.stack.detection.network import Network
from twin.stack.detection.roi import WIDTH

FOLDER = Path(__file__).parent / "data" / "detector"
SEED, KEPT = 77, 10


def judge(network: Network) -> list[Judged]:
    """The stored pictures, seen by a network."""
    judged = []
    for entry in json.loads((FOLDER / "labels.json").read_text()):
        image = cv2.cvtColor(cv2.imread(str(FOLDER / entry["file"])), cv2.COLOR_BGR2RGB)
        boxes = read_maps(network(np.asarray(image, np.uint8)[None]), WIDTH, FAINT)
        judged.append(
            Judged(
                truth=np.array([p[1:] for p in entry["wanted"]], float).reshape(-1, 4),
                truth_class=np.array([PART_CLASSES.index(p[0]) for p in entry["wanted"]], int),
                ignored=np.array(entry["ignored"], float).reshape(-1, 4),
                box=boxes.box,
                score=boxes.score,
                box_class=boxes.part_class,
            )
        )
    return judged


def write() -> None:
    """Draw pictures and store them with what is wanted in them."""
    from twin.training.dataset import make_set
    from twin.training.domain import HELD_OUT

    layout = load_layout()
    config = nominal_config(layout.site, layout.options)
    FOLDER.mkdir(parents=True, exist_ok=True)
    entries = []
    with tempfile.TemporaryDirectory() as folder:
        make_set(Path(folder), layout, HELD_OUT, SEED, KEPT)
        pictures = PictureSet(Path(folder))
        nothing = [np.full((h, w, 10), -20.0) for h, w in ((80, 104), (20, 26), (10, 13))]
        judged = judge_pictures(pictures, config, lambda image: nothing)
        for k in range(KEPT):
            image = region_of(pictures.shots[k], config).input(pictures.image(k))[0]
            file = f"{k:02d}.jpg"
            bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(FOLDER / file), bgr, [cv2.IMWRITE_JPEG_QUALITY, 92])
            j = judged[k]
            wanted = [
                [PART_CLASSES[c], *np.round(b, 1).tolist()]
                for c, b in zip(j.truth_class, j.truth, strict=True)
            ]
            ignored = np.round(j.ignored, 1).tolist()
            entries.append({"file": file, "wanted": wanted, "ignored": ignored})
    text = ",\n".join(json.dumps(entry) for entry in entries)
    (FOLDER / "labels.json").write_text(f"[\n{text}\n]\n")


if __name__ == "__main__":
    write()
