"""Reads what must be known of an ONNX file before it is run: its operator sets, external data.

A walk over the protobuf wire format (protobuf.dev, "Encoding") with the field numbers of
onnx.proto3 (ModelProto, GraphProto, TensorProto); the stack needs no ONNX library for it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

GRAPH, OPSET_IMPORT = 7, 8  # of ModelProto
EXTERNAL_DATA, DATA_LOCATION = 13, 14  # of TensorProto
DOMAIN, VERSION = 1, 2  # of OperatorSetIdProto
# Where tensors may be: what a message of each kind holds, by field number. A sparse tensor is
# told by two dense ones; a graph in an attribute is a branch or a loop's body.
HOLDS = {
    "model": {GRAPH: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
DEEPEST = 100  # messages in each other, as protobuf itself allows


@dataclass(frozen=True)
class OnnxFacts:
    """What a file says of itself."""

    opsets: dict[str, int]  # version by domain; "" is ONNX's own
    external: bool  # whether weights lie in other files


def read_facts(content: bytes) -> OnnxFacts:
    """Facts of an ONNX file.

    Raises:
        ValueError: it is none, or cut off.
    """
    opsets: dict[str, int] = {}
    has_graph = False
    for field, value in _fields(content):
        has_graph |= field == GRAPH
        if field == OPSET_IMPORT and isinstance(value, bytes):
            entry = dict(_fields(value))
            domain, version = entry.get(DOMAIN, b""), entry.get(VERSION, 0)
            if isinstance(domain, bytes) and isinstance(version, int):
                opsets[domain.decode("utf-8", "replace")] = version
    if not has_graph or not opsets:
        raise ValueError("not an ONNX model")
    external = any(
        field == EXTERNAL_DATA or (field == DATA_LOCATION and value != 0)
        for tensor in _tensors(content, "model")
        for field, value in _fields(tensor)
    )
    return OnnxFacts(opsets, external)


def _tensors(content: bytes, kind: str, depth: int = 0) -> Iterator[bytes]:
    """All tensors in a message of one kind, however deep."""
    if kind == "tensor":
        yield content
        return
    if depth > DEEPEST:
        raise ValueError("nested too deeply")
    for field, value in _fields(content):
        inner = HOLDS[kind].get(field)
        if inner is not None and isinstance(value, bytes):
            yield from _tensors(value, inner, depth + 1)


def _fields(content: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Field numbers and values of one message; groups are not used by ONNX."""
    at = 0
    while at < len(content):
        key, at = _varint(content, at)
        field, kind = key >> 3, key & 7
        if kind == 0:
            value, at = _varint(content, at)
            yield field, value
            continue
        if kind == 2:
            size, at = _varint(content, at)
        elif kind in (1, 5):
            size = 8 if kind == 1 else 4
        else:
            raise ValueError("not an ONNX model")
        if at + size > len(content):
            raise ValueError("cut off")
        yield field, content[at : at + size]
        at += size


def _varint(content: bytes, at: int) -> tuple[int, int]:
    """A number in groups of seven bits, and where it ends."""
    value = shift = 0
    while True:
        if at >= len(content):
            raise ValueError("cut off")
        byte = content[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
        if shift > 63:
            raise ValueError("not an ONNX model")
