"""What is written in a floor tag's QR code: a line that names the tag, its pose and the way on.

    T1:G7:12350:-3200:9000:N4/N5:1A2B

Version, id, x and y in millimetres, yaw in hundredths of a degree, nodes that can be reached from
here (may be empty), CRC-16. All characters are of the QR code's alphanumeric set, which packs two
into 11 bits, so that modules stay large. The checksum tells a tag from a foreign text; reading
errors are the code's own affair. The plant prints it, the stack reads it.
"""

import re
from binascii import crc_hqx
from dataclasses import dataclass

import numpy as np

VERSION = "T1"
ID = r"[A-Z0-9]{1,8}"
BODY = re.compile(
    rf"{VERSION}:(?P<id>{ID}):(?P<x>-?[0-9]{{1,7}}):(?P<y>-?[0-9]{{1,7}}):(?P<yaw>-?[0-9]{{1,5}})"
    rf":(?P<next>(?:{ID}(?:/{ID})*)?)"
)


@dataclass(frozen=True)
class TagText:
    """A floor tag as it describes itself."""

    tag_id: str
    pose: tuple[float, float, float]  # x, y in world, m; yaw of the code's upper edge, rad
    next_nodes: tuple[str, ...] = ()  # route hint


def format_tag(tag: TagText) -> str:
    """Text to print in a tag's code.

    Raises:
        ValueError: if an id or the pose does not fit the format.
    """
    x, y, yaw = tag.pose
    if not np.all(np.isfinite(tag.pose)):
        raise ValueError(f"tag {tag.tag_id}: pose {tag.pose} is not finite")
    numbers = f"{round(1e3 * x)}:{round(1e3 * y)}:{round(100 * np.degrees(yaw))}"
    body = f"{VERSION}:{tag.tag_id}:{numbers}:{'/'.join(tag.next_nodes)}"
    text = f"{body}:{checksum(body)}"
    if parse_tag(text) is None:
        raise ValueError(
            f"tag '{tag.tag_id}': {body} does not fit; ids are 1-8 of A-Z and 0-9, "
            "positions below 10 km, yaw within half a turn"
        )
    return text


def parse_tag(text: str) -> TagText | None:
    """Tag of a text; None if it is not one to the letter."""
    body, _, check = text.rpartition(":")
    match = BODY.fullmatch(body)
    if match is None or check != checksum(body) or abs(int(match["yaw"])) > 18000:
        return None
    pose = (1e-3 * int(match["x"]), 1e-3 * int(match["y"]), np.radians(0.01 * int(match["yaw"])))
    following = tuple(match["next"].split("/")) if match["next"] else ()
    return TagText(match["id"], (pose[0], pose[1], float(pose[2])), following)


def checksum(body: str) -> str:
    """CRC-16 (CCITT) of a code's body in four hexadecimal digits."""
    return f"{crc_hqx(body.encode('ascii', 'replace'), 0xFFFF):04X}"
