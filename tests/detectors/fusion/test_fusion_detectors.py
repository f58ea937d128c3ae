"""What MVX-Net and BEVFusion take and refuse; their numbers are in `test_fusion_parity`."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from lcf3d.detectors.fusion import bevfusion, mvxnet, view_transform  # noqa: E402
from lcf3d.detectors.fusion.images import image_of  # noqa: E402
from lcf3d.distortion import Distortion  # noqa: E402
from lcf3d.errors import ConfigError, DatasetError, DetectorError, ShapeError  # noqa: E402
from lcf3d.frame import Frame  # noqa: E402
from lcf3d.structures import Camera  # noqa: E402

# camera axes x right, y down, z forward from LiDAR axes x forward, y left, z up
CAMERA_FROM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
POINTS = np.array([[10, 0, 0, 0.5], [20, 2, -1, 0.1], [-10, 0, 0, 0.2], [5, 30, 0, 0.3]], np.float32)


def camera(name="left", width=640, height=192):
    projection = np.array([[500, 0, width / 2, 0], [0, 500, height / 2, 0], [0, 0, 1, 0]], np.float64)
    return Camera(name, projection, CAMERA_FROM_LIDAR, width, height)


def frame(cameras, points=POINTS, without=()):
    generator = np.random.default_rng(0)
    images = {c.name: generator.integers(0, 256, (c.height, c.width, 3), np.uint8) for c in cameras}
    return Frame("f", points, cameras, {name: image for name, image in images.items() if name not in without})


class Fake(torch.nn.Module):
    """Stands for a network whose output is never asked for."""


class TestImages:
    def test_an_image_of_another_size_is_refused(self):
        wrong = Frame("f", POINTS, [camera()], {"left": np.zeros((10, 10, 3), np.uint8)})
        with pytest.raises(ShapeError, match=r"must have shape \(192, 640, 3\).*got \(10, 10, 3\)"):
            image_of(wrong, camera())

    def test_a_lens_is_refused(self):
        plain = camera()
        lens = Distortion("brown_conrady", (0.1, 0, 0, 0))
        bent = Camera("left", plain.projection, CAMERA_FROM_LIDAR, 640, 192, lens)
        with pytest.raises(ConfigError, match="brown_conrady distortion of camera 'left'; undistort"):
            image_of(frame([bent]), bent)


class TestMVXNet:
    def test_inputs(self):
        detector = mvxnet.MVXNet(Fake())
        inputs = detector.inputs(frame([camera()]))
        assert inputs["features"].shape == (2, 10)
        # 640 x 192 fits 1280 x 384 twice
        assert inputs["image"].shape == (1, 3, 384, 1280)
        # the point straight ahead is seen in the middle
        first = np.flatnonzero(inputs["features"][:, 0] == 10)[0]
        np.testing.assert_allclose(inputs["pixels"][first], [0, 0], atol=1e-6)

    def test_colour_order_and_padding(self):
        image = np.zeros((30, 40, 3), np.uint8)
        image[..., 2] = 200
        prepared = mvxnet.prepare_image(image, 40, 30)
        assert prepared.shape == (1, 3, 32, 64)
        np.testing.assert_allclose(prepared[0, :, 0, 0], [200 - 102.9801, -115.9465, -122.7717], rtol=1e-6)
        assert not prepared[0, :, 30:].any()
        assert not prepared[0, :, :, 40:].any()

    def test_nothing_seen_is_no_detection(self):
        found = mvxnet.MVXNet(Fake()).detect_frame(frame([camera()], POINTS[2:]))
        assert len(found) == 0
        assert found.class_names == ("Pedestrian", "Cyclist", "Car")

    def test_missing_modalities(self):
        detector = mvxnet.MVXNet(Fake())
        with pytest.raises(DatasetError, match="no image of camera left"):
            detector.detect_frame(frame([camera()], without=["left"]))
        with pytest.raises(DatasetError, match="no scan"):
            detector.detect_frame(frame([camera()], points=None))
        with pytest.raises(ConfigError, match="no camera 'left'; it has"):
            detector.detect_frame(frame([camera("front")]))

    @pytest.mark.parametrize("options", [{"nms": "some"}, {"score_threshold": 1.5}, {"device": "abacus"}])
    def test_settings_out_of_range(self, options):
        with pytest.raises(ConfigError):
            mvxnet.MVXNet(Fake(), **options)

    def test_another_network_is_refused(self):
        with pytest.raises(DetectorError, match="mvxnet-kitti is of another architecture"):
            mvxnet.MVXNet.from_state_dict({"backbone.weight": torch.zeros(1)})


class TestBEVFusion:
    def detector(self, cameras=True):
        network = Fake()
        if cameras:
            network.view_transform = Fake()
        return bevfusion.BEVFusion(network)

    def test_points_are_turned(self):
        inputs = self.detector(cameras=False).inputs(frame([]))
        # one point ahead, x = 10, is at y = 10 in the network's frame: row (10 + 54) / 0.075
        ahead = inputs["features"][:, 1] == 10
        assert inputs["coordinates"][ahead].tolist() == [[25, 853, 720]]
        assert inputs["features"].shape == (4, 5)

    def test_any_number_of_cameras(self):
        cameras = [camera(name, 1600, 900) for name in ("a", "b", "c")]
        inputs = self.detector().inputs(frame(cameras, without=["b"]))
        assert inputs["images"].shape == (2, 3, 256, 704)
        assert inputs["depths"].shape == (2, 1, 256, 704)
        assert inputs["cells"].shape == (2, 118, 32, 88)
        # the points ahead are seen straight ahead, at their depths
        assert sorted(inputs["depths"][0][inputs["depths"][0] != 0]) == [10, 20]

    def test_a_flat_image_gets_black_rows_at_the_top(self):
        image = np.full((375, 1242, 3), 255, np.uint8)
        prepared, (scale, left, top) = bevfusion.prepare_image(image)
        assert scale == pytest.approx(768 / 1242)
        assert (left, top) == (32, 231 - 256)
        np.testing.assert_allclose(prepared[:, 0, 0], -bevfusion.MEAN / bevfusion.STD, rtol=1e-6)
        np.testing.assert_allclose(prepared[:, 255, 0], (255 - bevfusion.MEAN) / bevfusion.STD, rtol=1e-6)

    def test_missing_modalities(self):
        with pytest.raises(DatasetError, match="has no image, and this BEVFusion looks at points and images"):
            self.detector().detect_frame(frame([camera()], without=["left"]))
        with pytest.raises(DatasetError, match="no scan"):
            self.detector().detect_frame(frame([camera()], points=None))

    def test_no_point_in_range_is_no_detection(self):
        far = np.array([[200, 0, 0, 1]], np.float32)
        assert len(self.detector(cameras=False).detect_frame(frame([], far))) == 0

    def test_kernels_of_both_layouts_become_the_same(self):
        kernel = torch.randn(3, 3, 3, 5, 16)
        name = "pts_middle_encoder.conv_input.0.weight"
        ours = bevfusion.own_parameters({name: kernel})[name]
        spconv = bevfusion.own_parameters({name: kernel.permute(4, 0, 1, 2, 3)})[name]
        # x and z exchanged, in either
        assert torch.equal(ours, kernel.permute(2, 1, 0, 3, 4))
        assert torch.equal(spconv, ours.permute(4, 0, 1, 2, 3))

    def test_constants_are_compared_and_left_out(self):
        constants = {f"view_transform.{name}": value for name, value in view_transform.constants().items()}
        index = {"img_backbone.stages.0.blocks.0.attn.w_msa.relative_position_index": torch.zeros(49, 49)}
        assert bevfusion.own_parameters({**constants, **index}) == {}
        other = {"view_transform.frustum": torch.zeros(118, 16, 44, 3)}
        with pytest.raises(DetectorError, match="trained for another geometry"):
            bevfusion.own_parameters(other)
