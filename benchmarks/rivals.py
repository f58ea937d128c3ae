"""Seconds a frame of the rival networks, beside those of the originals on one thread of another machine.

    python benchmarks/rivals.py --kitti KITTI --nuscenes NUSCENES

Weights are random: what a network costs does not depend on them. Frames are those of the parity data: KITTI's 000008
(of its image the 2D detectors get the upper left 512 x 255 pixels), and the first sample of nuScenes' scene-0061.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

from lcf3d.datasets.kitti import KittiDataset
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.detectors.camera.ddq import DDQNetwork
from lcf3d.detectors.camera.detectors_cascade import DetectoRSNetwork
from lcf3d.detectors.fusion.bevfusion import BEVFusion, BEVFusionNetwork
from lcf3d.detectors.fusion.detector import FusionDetector
from lcf3d.detectors.fusion.mvxnet import MVXNet, MVXNetwork
from lcf3d.detectors.lidar.fusing import fuse_batch_norm
from lcf3d.frame import Frame
from lcf3d.networks.torch import torch

ORIGINAL_SECONDS = {
    "MVX-Net": 4.59,
    "BEVFusion": 14.41,
    "BEVFusion, LiDAR only": 3.61,
    "DDQ-DETR R-50": 2.84,
    "DDQ-DETR Swin-L": 6.55,
    "DetectoRS": 6.64,
}
"""Processor seconds of OpenMMLab's code on the same frames, one thread, as recorded with the parity data."""


def runs(kitti: str, nuscenes: str, device: str) -> dict[str, Callable[[], Callable[[], object]]]:
    """By name, what builds what is timed."""
    drive = KittiDataset(kitti).frame("000008")
    scene = NuscenesDataset(nuscenes).frame("ca9a282c9e77460f8360f564131a8af5")
    crop = torch.from_numpy(drive.images["left"][:255, :512].copy()).permute(2, 0, 1)[None].float() / 128 - 1
    padded = torch.nn.functional.pad(crop, (0, 0, 0, 1)).to(device)

    def camera(build: Callable[[], torch.nn.Module], *inputs: object) -> Callable[[], object]:
        network = fuse_batch_norm(build().eval()).requires_grad_(False).to(device)
        return lambda: network(*inputs)

    def fusion(detector: FusionDetector, frame: Frame) -> Callable[[], object]:
        return lambda: detector.detect_frame(frame)

    return {
        "MVX-Net": lambda: fusion(MVXNet(MVXNetwork(), device=device), drive),
        "BEVFusion": lambda: fusion(BEVFusion(BEVFusionNetwork(cameras=True), device=device), scene),
        "BEVFusion, LiDAR only": lambda: fusion(BEVFusion(BEVFusionNetwork(cameras=False), device=device), scene),
        "DDQ-DETR R-50": lambda: camera(lambda: DDQNetwork(False, 80), crop.to(device)),
        "DDQ-DETR Swin-L": lambda: camera(lambda: DDQNetwork(True, 80), crop.to(device)),
        "DetectoRS": lambda: camera(lambda: DetectoRSNetwork(80), padded, 255, 512),
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kitti", required=True)
    parser.add_argument("--nuscenes", required=True)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"{'network':24}{'processor s':>12}{'wall s':>8}{'original s':>12}")
    for name, build in runs(options.kitti, options.nuscenes, options.device).items():
        torch.manual_seed(0)
        run = build()
        processor, wall = [], []
        with torch.inference_mode():
            for _ in range(options.repeats + 1):
                begun, spent = time.perf_counter(), time.process_time()
                run()
                if options.device != "cpu":
                    torch.cuda.synchronize()
                processor.append(time.process_time() - spent)
                wall.append(time.perf_counter() - begun)
        # the first time warms up
        medians = statistics.median(processor[1:]), statistics.median(wall[1:])
        print(f"{name:24}{medians[0]:12.2f}{medians[1]:8.2f}{ORIGINAL_SECONDS[name]:12.2f}", flush=True)


if __name__ == "__main__":
    main()
