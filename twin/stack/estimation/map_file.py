"""Maps on disk: a PGM picture and a YAML header, the format of the ROS map_server.

http://wiki.ros.org/map_server, "Map format": black is occupied, white free, the grey 205 unknown;
the picture's first row is the northernmost. Only turned-off rotation and `mode: trinary` are known.
"""

import re
from pathlib import Path

import numpy as np

from twin.stack.estimation.occupancy_grid import FREE, OCCUPIED, OccupancyGrid

BLACK, GREY, WHITE = 0, 205, 254
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196  # of darkness; 205 is 0.19608, hence unknown
CERTAIN = 4.0  # log-odds given to a cell that a file calls occupied or free
MAX_CELLS = 100_000_000  # 500 m x 500 m at 50 mm: more is a broken header
NEEDED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


def save_map(grid: OccupancyGrid, yaml_path: Path) -> None:
    """Write `<stem>.yaml` and `<stem>.pgm` side by side, each complete or not at all."""
    yaml_path = Path(yaml_path)
    states = grid.states()
    picture = np.full(states.shape, GREY, dtype=np.uint8)
    picture[states == OCCUPIED], picture[states == FREE] = BLACK, WHITE
    pgm_path = yaml_path.with_suffix(".pgm")
    head = f"P5\n{states.shape[1]} {states.shape[0]}\n255\n".encode()
    _write(pgm_path, head + picture[::-1].tobytes())
    x, y = map(float, grid.origin)
    text = (
        f"image: {pgm_path.name}\nmode: trinary\nresolution: {grid.resolution}\n"
        f"origin: [{x}, {y}, 0.0]\nnegate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESH}\nfree_thresh: {FREE_THRESH}\n"
    )
    _write(yaml_path, text.encode())


def load_map(yaml_path: Path, shape: tuple[int, int] | None = None) -> OccupancyGrid:
    """Read a map.

    Args:
        yaml_path: the header; its picture lies beside it.
        shape: rows and columns that the map must have, where that is known.

    Raises:
        ValueError: one line, for a file that is missing, truncated, of another size or malformed.
    """
    yaml_path = Path(yaml_path)
    head = _read_head(yaml_path)
    try:
        resolution = float(head["resolution"])
        origin = [float(v) for v in head["origin"].strip("[]").split(",")]
        negate = int(head["negate"])
        occupied, free = float(head["occupied_thresh"]), float(head["free_thresh"])
    except ValueError as error:
        raise ValueError(f"map {yaml_path}: {error}") from None
    if len(origin) != 3 or not np.all(np.isfinite(origin)) or origin[2] != 0:
        raise ValueError(f"map {yaml_path}: origin {head['origin']}, wanted [x, y, 0]")
    if not (0 < resolution < np.inf) or negate not in (0, 1) or not (0 <= free < occupied <= 1):
        raise ValueError(
            f"map {yaml_path}: wanted resolution > 0, negate 0 or 1, "
            "0 <= free_thresh < occupied_thresh <= 1"
        )
    if head.get("mode", "trinary") != "trinary":
        raise ValueError(f"map {yaml_path}: mode {head['mode']}, known is trinary")
    picture = _read_picture(yaml_path.parent / head["image"].strip("'\""))
    if shape is not None and picture.shape != tuple(shape):
        raise ValueError(f"map {yaml_path}: {picture.shape} cells, wanted {tuple(shape)}")
    darkness = (picture if negate else 255.0 - picture) / 255.0
    log_odds = np.where(darkness > occupied, CERTAIN, np.where(darkness < free, -CERTAIN, 0.0))
    return OccupancyGrid(np.array(origin[:2]), resolution, log_odds[::-1].astype(np.float32))


def _read_head(path: Path) -> dict[str, str]:
    """Keys and values of the flat YAML that map_server writes."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"map {path}: cannot be read ({error})") from None
    pairs = (line.split("#")[0].partition(":") for line in lines)
    head = {key.strip(): value.strip() for key, colon, value in pairs if colon}
    missing = [key for key in NEEDED if not head.get(key)]
    if missing:
        raise ValueError(f"map {path}: lacks {', '.join(missing)}")
    return head


def _read_picture(path: Path) -> np.ndarray:
    """Grey values, row 0 at the top. Shape (h, w), uint8."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ValueError(f"map picture {path}: cannot be read ({error})") from None
    gap = rb"(?:\s|#[^\n]*\n)+"  # white space and comments between the header's words
    head = re.match(rb"P5" + gap + rb"(\d{1,9})" + gap + rb"(\d{1,9})" + gap + rb"255\s", data)
    if head is None:
        raise ValueError(f"map picture {path}: not a binary PGM (P5) of 8 bits")
    width, height = int(head[1]), int(head[2])
    if not 0 < width * height <= MAX_CELLS:
        raise ValueError(f"map picture {path}: {width} x {height} cells")
    found = len(data) - head.end()
    if found != width * height:
        raise ValueError(
            f"map picture {path}: {found} bytes of cells, wanted {width} x {height} = "
            f"{width * height}"
        )
    return np.frombuffer(data, dtype=np.uint8, offset=head.end()).reshape(height, width)


def _write(path: Path, data: bytes) -> None:
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    part.replace(path)
