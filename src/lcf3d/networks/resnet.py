"""ResNet (He et al., CVPR 2016) as a backbone, on torchvision's layers."""

# mypy: allow-subclassing-any
from __future__ import annotations

from lcf3d.networks.torch import Tensor, functional, nn, torchvision


class ResNet(nn.Module):
    """torchvision's ResNet without its classifier.

    Args:
        depth: 50 or 101.
        caffe: the stride of a bottleneck is in its first convolution instead of its second.
    """

    def __init__(self, depth: int, caffe: bool) -> None:
        super().__init__()
        resnet = getattr(torchvision().models, f"resnet{depth}")(weights=None)
        for name in ("conv1", "bn1", "layer1", "layer2", "layer3", "layer4"):
            setattr(self, name, getattr(resnet, name))
        if caffe:
            for layer in (self.layer2, self.layer3, self.layer4):
                layer[0].conv1.stride, layer[0].conv2.stride = (2, 2), (1, 1)

    def forward(self, image: Tensor) -> list[Tensor]:
        """(N, 3, H, W) -> maps of 256, 512, 1024 and 2048 channels at strides 4, 8, 16 and 32."""
        x = functional.relu(self.bn1(self.conv1(image)))
        x = functional.max_pool2d(x, 3, 2, 1)
        maps = []
        for layer in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = layer(x)
            maps.append(x)
        return maps
