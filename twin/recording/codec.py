"""Messages and beliefs as bytes and back, exactly: what is read equals what was written.

A record is a JSON text and a payload. The text holds dataclasses by name (those of beliefs with
their module in the stack) and plain values; arrays stand in the payload, pictures as PNG
(lossless), all others raw.
"""

import dataclasses
import json
from importlib import import_module
from typing import Any

import cv2
import numpy as np

from twin import messages

_TYPES = {
    name: kind
    for name, kind in vars(messages).items()
    if isinstance(kind, type) and dataclasses.is_dataclass(kind)
}
# Noise makes pictures hard to pack: the quick method loses nothing against the thorough one.
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]


def encode(value: Any) -> tuple[bytes, bytes]:
    """JSON text and payload of messages, tuples of them, plain values and arrays."""
    blobs: list[bytes] = []
    tree = _pack(value, blobs)
    return json.dumps(tree, separators=(",", ":")).encode(), b"".join(blobs)


def decode(text: bytes, payload: bytes) -> Any:
    """The value again; sequences come back as tuples."""
    return _unpack(json.loads(text), memoryview(payload))


def same(first: Any, second: Any) -> bool:
    """Whether two values are equal to the bit, NaN and signed zeros included."""
    return encode(first) == encode(second)


def _pack(value: Any, blobs: list[bytes]) -> Any:
    if isinstance(value, np.ndarray):
        picture = _is_picture(value)
        blob = cv2.imencode(".png", value, _PNG)[1].tobytes() if picture else value.tobytes()
        blobs.append(blob)
        start = sum(map(len, blobs[:-1]))
        return {"array": [value.dtype.str, value.shape, picture, start, len(blob)]}
    if dataclasses.is_dataclass(value):
        fields = {f.name: _pack(getattr(value, f.name), blobs) for f in dataclasses.fields(value)}
        return {"type": _name(type(value)), **fields}
    if isinstance(value, tuple | list):
        return [_pack(item, blobs) for item in value]
    if isinstance(value, dict):
        return {"dict": {key: _pack(item, blobs) for key, item in value.items()}}
    return value.item() if isinstance(value, np.generic) else value


def _unpack(tree: Any, payload: memoryview) -> Any:
    if isinstance(tree, list):
        return tuple(_unpack(item, payload) for item in tree)
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        dtype, shape, picture, start, length = tree["array"]
        blob = np.frombuffer(payload[start : start + length], np.uint8)
        if picture:
            return cv2.imdecode(blob, cv2.IMREAD_UNCHANGED)
        return blob.view(dtype).reshape(shape).copy()
    if "dict" in tree:
        return {key: _unpack(item, payload) for key, item in tree["dict"].items()}
    kind = _kind(tree["type"])
    return kind(**{name: _unpack(v, payload) for name, v in tree.items() if name != "type"})


def _name(kind: type) -> str:
    known = _TYPES.get(kind.__name__) is kind
    return kind.__name__ if known else f"{kind.__module__}:{kind.__name__}"


def _kind(name: str) -> type:
    module, _, last = name.rpartition(":")
    if not module:
        return _TYPES[last]
    if not module.startswith("twin.stack."):
        raise ValueError(f"log: a message of type {name}, which is none of the stack's")
    return getattr(import_module(module), last)


def _is_picture(array: np.ndarray) -> bool:
    colour = array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3
    plane = array.dtype in (np.uint8, np.uint16) and array.ndim == 2
    return array.size > 0 and (colour or plane)
