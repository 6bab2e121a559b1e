"""Pictures of the camera, with labels. Run as a script to write tests/data/detector."""

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

from evaluation.detection import Judged
from evaluation.judging import judge_pictures
from evaluation.pictures import PictureSet, from_json, to_json
from twin.layout import load_layout
from twin.stack.config import nominal_config
from twin.stack.detection.network import Network

FOLDER = Path(__file__).parent / "data" / "detector"
SEED, KEPT = 77, 10


class Stored:
    """The stored pictures, as a `PictureSet` gives them."""

    def __init__(self):
        self.shots = [from_json(s) for s in json.loads((FOLDER / "labels.json").read_text())]

    def __len__(self) -> int:
        return len(self.shots)

    def image(self, k: int) -> np.ndarray:
        """Pixels of one picture."""
        bgr = cv2.imread(str(FOLDER / f"{k:02d}.jpg"))
        return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def judge(network: Network) -> list[Judged]:
    """The stored pictures, seen by a network."""
    layout = load_layout()
    return judge_pictures(Stored(), nominal_config(layout.site, layout.options), network)


def write() -> None:
    """Draw pictures and store them with what is known of them."""
    from twin.training.dataset import make_set
    from twin.training.domain import HELD_OUT

    FOLDER.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        make_set(Path(folder), load_layout(), HELD_OUT, SEED, KEPT)
        pictures = PictureSet(Path(folder))
        for k in range(KEPT):
            bgr = cv2.cvtColor(pictures.image(k), cv2.COLOR_RGB2BGR)
            path = str(FOLDER / f"{k:02d}.jpg")
            cv2.imwrite(path, bgr, [cv2.IMWRITE_JPEG_QUALITY, 92])
        text = ",\n".join(json.dumps(to_json(shot)) for shot in pictures.shots)
    (FOLDER / "labels.json").write_text(f"[\n{text}\n]\n")


if __name__ == "__main__":
    write()
