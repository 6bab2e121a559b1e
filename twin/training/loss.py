"""What the network is trained to: which cell answers for which part, and how wrong it is."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from twin.stack.detection.boxes import MAX_LOG_SIZE
from twin.training.network import Design

LEVEL_SIZE = {4: 64.0, 16: 128.0, 32: math.inf}  # px: longer parts belong to the next stride
RADIUS = 1.5  # cells about a part's centre that answer for it
FOCUS = 2.0  # exponent by which easy empty cells are passed over (Lin et al. 2017)
BOX, OBJECT, CLASS = 2.0, 1.0, 2.0  # weights; not tuned


@dataclass(frozen=True)
class Target:
    """What one picture shows. Boxes are left, top, right, bottom in px."""

    boxes: Tensor  # (k, 4)
    classes: Tensor  # (k,) int64
    ignored: Tensor  # (j, 4) hardly seen parts: neither there nor not there


def decode(raw: Tensor, stride: int) -> Tensor:
    """Boxes of one map: cell and offset give the centre, exponentials the size (Ge et al. 2021).

    Args:
        raw: map with at least four channels. Shape (n, c, h, w).
        stride: px a cell.

    Returns:
        left, top, right, bottom, px. Shape (n, h, w, 4).
    """
    h, w = raw.shape[2:]
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    cx = (raw[:, 0] + u + 0.5) * stride
    cy = (raw[:, 1] + v + 0.5) * stride
    half_w = raw[:, 2].clamp(max=MAX_LOG_SIZE).exp() * stride / 2
    half_h = raw[:, 3].clamp(max=MAX_LOG_SIZE).exp() * stride / 2
    return torch.stack([cx - half_w, cy - half_h, cx + half_w, cy + half_h], dim=-1)


def assign(target: Target, stride: int, smallest: float, h: int, w: int) -> tuple[Tensor, Tensor]:
    """Which part each cell of a map answers for.

    Args:
        target: the parts.
        stride: px a cell.
        smallest: px; parts whose longer side is below belong to a finer map.
        h: rows of the map.
        w: columns of the map.

    Returns:
        Index of the part, -1 for none, (h, w); and whether the cell counts as empty, (h, w).
    """
    owner = torch.full((h, w), -1, dtype=torch.long)
    empty = torch.ones((h, w), dtype=torch.bool)
    centre_v = (torch.arange(h) + 0.5)[:, None] * stride
    centre_u = (torch.arange(w) + 0.5)[None, :] * stride
    for left, top, right, bottom in target.ignored.tolist():
        inside = (centre_u > left) & (centre_u < right) & (centre_v > top) & (centre_v < bottom)
        empty &= ~inside
    nearest = torch.full((h, w), math.inf)
    for k, (left, top, right, bottom) in enumerate(target.boxes.tolist()):
        if not smallest <= max(right - left, bottom - top) < LEVEL_SIZE[stride]:
            continue
        du = (centre_u - (left + right) / 2).abs()
        dv = (centre_v - (top + bottom) / 2).abs()
        distance = torch.maximum(du, dv)
        mine = (distance < RADIUS * stride) & (distance < nearest)
        owner[mine] = k
        nearest[mine] = distance[mine]
    return owner, empty & (owner < 0)


def ciou(first: Tensor, second: Tensor) -> Tensor:
    """Complete intersection over union (Zheng et al. 2020, Eqs. 8-11). Shape (k, 4) to (k,)."""
    low = torch.maximum(first[:, :2], second[:, :2])
    high = torch.minimum(first[:, 2:], second[:, 2:])
    both = (high - low).clamp(min=0).prod(dim=1)
    size1, size2 = first[:, 2:] - first[:, :2], second[:, 2:] - second[:, :2]
    iou = both / (size1.prod(dim=1) + size2.prod(dim=1) - both + 1e-9)
    hull = torch.maximum(first[:, 2:], second[:, 2:]) - torch.minimum(first[:, :2], second[:, :2])
    apart = (first[:, :2] + first[:, 2:] - second[:, :2] - second[:, 2:]) / 2
    distance = apart.square().sum(dim=1) / (hull.square().sum(dim=1) + 1e-9)
    angle1 = torch.atan(size1[:, 0] / (size1[:, 1] + 1e-9))
    angle2 = torch.atan(size2[:, 0] / (size2[:, 1] + 1e-9))
    shape = 4 / math.pi**2 * (angle1 - angle2).square()
    with torch.no_grad():
        weight = shape / (1 - iou + shape + 1e-9)
    return iou - distance - weight * shape


def loss(maps: list[Tensor], targets: list[Target], design: Design) -> dict[str, Tensor]:
    """Parts of the loss, each a mean over the cells that answer for a part; `total` is their sum.

    Args:
        maps: of the network, finest first.
        targets: one a picture.
        design: without `ciou` boxes are fitted by the squares of their four numbers (YOLOv3).
    """
    strides = (4, 16, 32) if design.fine_map else (16, 32)
    box = obj = cls = torch.zeros(())
    count = 0
    smallest = 0.0
    for raw, stride in zip(maps, strides, strict=True):
        h, w = raw.shape[2:]
        assigned = [assign(t, stride, smallest, h, w) for t in targets]
        smallest = LEVEL_SIZE[stride]
        owner = torch.stack([a for a, _ in assigned])
        empty = torch.stack([b for _, b in assigned])
        n, v, u = torch.nonzero(owner >= 0, as_tuple=True)
        logit = raw[:, 4]
        chance = logit[empty].sigmoid().detach()
        obj = obj + (functional.softplus(logit[empty]) * chance**FOCUS).sum()
        if len(n) == 0:
            continue
        count += len(n)
        owners = list(zip(n.tolist(), owner[n, v, u].tolist(), strict=True))
        wanted = torch.stack([targets[i].boxes[k] for i, k in owners])
        classes = torch.stack([targets[i].classes[k] for i, k in owners])
        if design.ciou:
            box = box + (1 - ciou(decode(raw, stride)[n, v, u], wanted)).sum()
        else:
            box = box + (raw[n, :4, v, u] - encode(wanted, v, u, stride)).square().sum() / 4
        obj = obj + functional.softplus(-logit[n, v, u]).sum()
        cls = cls + functional.cross_entropy(raw[n, 5:, v, u], classes, reduction="sum")
    scale = 1.0 / max(count, 1)
    parts = {"box": BOX * scale * box, "object": OBJECT * scale * obj, "class": CLASS * scale * cls}
    return parts | {"total": parts["box"] + parts["object"] + parts["class"]}


def encode(boxes: Tensor, v: Tensor, u: Tensor, stride: int) -> Tensor:
    """What a cell should say for a box: the inverse of `decode`. Shape (k, 4)."""
    cx, cy = (boxes[:, 0] + boxes[:, 2]) / 2, (boxes[:, 1] + boxes[:, 3]) / 2
    size = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1.0)
    return torch.stack(
        [
            cx / stride - u - 0.5,
            cy / stride - v - 0.5,
            (size[:, 0] / stride).log(),
            (size[:, 1] / stride).log(),
        ],
        dim=1,
    )
