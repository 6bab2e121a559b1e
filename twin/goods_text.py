"""What is written in a goods code: which rack a parcel is for.

    G1:7:9C4F

Version, number of the rack, CRC-16. Nine characters of the QR code's alphanumeric set fit the
smallest code, whose 21 modules are large enough for the mast camera.
"""

import re

from twin.tag_text import checksum

VERSION = "G1"
BODY = re.compile(rf"{VERSION}:(?P<rack>[1-9][0-9]{{0,2}})")


def format_goods(rack: int) -> str:
    """Text to print in the code of a parcel for a rack.

    Raises:
        ValueError: the number is not 1 to 999.
    """
    body = f"{VERSION}:{rack}"
    text = f"{body}:{checksum(body)}"
    if parse_goods(text) is None:
        raise ValueError(f"rack {rack}: a goods code names a rack from 1 to 999")
    return text


def parse_goods(text: str) -> int | None:
    """Rack of a text; None if it is no goods code to the letter."""
    body, _, check = text.rpartition(":")
    match = BODY.fullmatch(body)
    return None if match is None or check != checksum(body) else int(match["rack"])
