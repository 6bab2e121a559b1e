"""The detector's network: a YOLO-Fastest backbone with what Li & An 2025, section 3.1, add to it.

Backbone of inverted residuals after YOLO-Fastest (dog-qiuqiu 2020), heads at 1/32 and 1/16 of the
input. Added: a map at 1/4 (104 x 104 at 416 input) for small parts, into which the deeper maps are
fed back, and attention that weighs the features by their surroundings, to tell similar classes
apart. Fully convolutional and local throughout: trained on crops, used on whole pictures.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from twin.messages import PART_CLASSES
from twin.stack.config import Camera
from twin.stack.detection.boxes import Boxes, read_maps
from twin.stack.detection.roi import WIDTH, Region

OUTPUTS = 5 + len(PART_CLASSES)  # box, object, classes
NECK = 40  # channels of the maps that the heads look at
WIDTHS = (12, 20, 32, 64, 112)  # channels at 1/2, 1/4, 1/8, 1/16, 1/32
DEPTHS = (2, 4, 3, 2)  # residual blocks after each step down from 1/4 on
EMPTY = -4.0  # first bias of "object": next to all cells are empty
FAINT = 0.02  # score from which boxes are kept, for the whole curve of precision over recall


@dataclass(frozen=True)
class Design:
    """Which of the source's improvements are in; each has its line in the ablation."""

    attention: bool = True
    fine_map: bool = True
    ciou: bool = True  # of the loss, not of the network


class Detector(nn.Module):
    """Pictures to raw maps.

    Args:
        design: which improvements are in.
    """

    def __init__(self, design: Design | None = None):
        super().__init__()
        self.design = design or Design()
        w = WIDTHS
        self.stem = conv(3, w[0], 3, 2)
        self.stages = nn.ModuleList(
            nn.Sequential(
                Block(w[i], w[i + 1], 2 if i == 0 else 3, 2),
                *[Block(w[i + 1], w[i + 1], 3, 1) for _ in range(DEPTHS[i])],
            )
            for i in range(4)
        )
        # Numbered by the stage whose features they take; attention in the order of the maps.
        self._levels = levels = (0, 1, 2, 3) if self.design.fine_map else (2, 3)
        self.lateral = _by_number({i: nn.Conv2d(w[i + 1], NECK, 1, bias=False) for i in levels})
        self.norm = _by_number({i: nn.BatchNorm2d(NECK) for i in levels})
        self.mix = _by_number({i: _separable(NECK, 5 if i == 0 else 3) for i in levels})
        weighed = [i // 2 for i in levels if i in (0, 2)] if self.design.attention else []
        self.attention = _by_number({k: _Attention(NECK) for k in weighed})
        self.heads = nn.ModuleList(
            nn.Sequential(_separable(NECK, 3), nn.Conv2d(NECK, OUTPUTS, 1)) for _ in self.strides
        )
        for head in self.heads:
            nn.init.constant_(head[1].bias, 0.0)  # type: ignore[index]
            nn.init.constant_(head[1].bias[4], EMPTY)  # type: ignore[index]

    @property
    def strides(self) -> tuple[int, ...]:
        """Pixels a cell of each map, finest first."""
        return (4, 16, 32) if self.design.fine_map else (16, 32)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Maps of (tx, ty, tw, th, object, classes), finest first.

        Args:
            x: RGB from -0.5 to 0.5. Shape (n, 3, h, w), h and w multiples of 32.

        Returns:
            One tensor a stride. Shape (n, 10, h / stride, w / stride).
        """
        features, x = [], self.stem(x)
        for stage in self.stages:
            x = stage(x)
            features.append(x)
        maps: dict[int, Tensor] = {}
        above: Tensor | None = None
        for i in reversed(self._levels):
            y = self.norm[str(i)](self.lateral[str(i)](features[i]))
            if above is not None:
                y = y + nn.functional.interpolate(above, scale_factor=2.0, mode="nearest")
            above = self.mix[str(i)](torch.relu(y))
            if self.design.attention and i in (0, 2):
                above = self.attention[str(i // 2)](above)
            maps[i] = above
        used = [maps[i] for i in (0, 2, 3) if i in maps]
        return [head(y) for head, y in zip(self.heads, used, strict=True)]


class Exportable(nn.Module):
    """The network as the stack runs it: a picture as it comes from the camera, maps with the
    channels last."""

    def __init__(self, detector: Detector):
        super().__init__()
        self.detector = detector

    def forward(self, image: Tensor) -> tuple[Tensor, ...]:
        """`image`: RGB. Shape (1, h, w, 3), uint8. Maps of shape (h / stride, w / stride, 10)."""
        x = image.permute(0, 3, 1, 2).float() / 255.0 - 0.5
        return tuple(y[0].permute(1, 2, 0) for y in self.detector(x))


class OneLook:
    """The network itself as the stack would run it, without the second look; while it is trained.

    Args:
        network: that looks.
    """

    def __init__(self, network: Detector):
        self._network, self._model = network, Exportable(network)

    @torch.no_grad()
    def see(
        self, image: NDArray[np.uint8], region: Region, camera: Camera, plane_z: float
    ) -> Boxes:
        """As `twin.stack.detection.network.Network.see`."""
        self._network.eval()
        maps = [m.numpy() for m in self._model(torch.from_numpy(region.input(image)))]
        boxes = read_maps(maps, WIDTH, FAINT)
        return Boxes(region.to_image(boxes.box), boxes.score, boxes.chances)


class Block(nn.Module):
    """Inverted residual: widen, look around, narrow. It begins as the identity (He et al. 2019)."""

    def __init__(self, inside: int, outside: int, expansion: int, stride: int):
        super().__init__()
        wide = inside * expansion
        self.body = nn.Sequential(
            conv(inside, wide, 1),
            conv(wide, wide, 3, stride, groups=wide),
            nn.Conv2d(wide, outside, 1, bias=False),
            nn.BatchNorm2d(outside),
        )
        self.adds = stride == 1 and inside == outside
        if self.adds:
            nn.init.zeros_(self.body[-1].weight)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        y = self.body(x)
        return x + y if self.adds else y


class _Attention(nn.Module):
    """Each feature weighed by what stands around it, within 5 x 5 cells.

    A local gate in place of squeeze-and-excitation: a mean over the whole picture would differ
    between the crops of the training and the pictures of the belt.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.gate = nn.Sequential(
            nn.Conv2d(channels, channels, 5, padding=2, groups=channels, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 1),
            nn.Sigmoid(),
        )

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gate(x) * 2.0


def conv(inside: int, outside: int, size: int, stride: int = 1, groups: int = 1) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(inside, outside, size, stride, size // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outside),
        nn.ReLU(),
    )


def _by_number(layers: dict[int, nn.Module]) -> nn.ModuleDict:
    return nn.ModuleDict({str(number): layer for number, layer in layers.items()})


def _separable(channels: int, size: int) -> nn.Module:
    return nn.Sequential(
        conv(channels, channels, size, groups=channels), conv(channels, channels, 1)
    )


def parameters(network: nn.Module) -> int:
    """Number of trained numbers."""
    return sum(p.numel() for p in network.parameters())


def multiplications(network: nn.Module, height: int, width: int) -> int:
    """Multiply-accumulates of all convolutions for one picture."""
    total = 0

    def count(layer, inputs, output):
        nonlocal total
        total += output.numel() * layer.weight[0].numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    with torch.no_grad():
        network.eval()(torch.zeros(1, 3, height, width))
    for hook in hooks:
        hook.remove()
    return total
