"""The authors' frustum network against the golden data of their release."""

import json
from pathlib import Path

import numpy as np
import pytest

from lcf3d.errors import DetectorError
from lcf3d.localizers.spec import LocalizerSpec, decode_boxes, split_outputs

torch = pytest.importorskip("torch")

PARTS = ("center_res", "size_reg", "size_cls", "head_reg", "head_cls")


def golden_network(shared: Path, name: str, dataset: str):
    from lcf3d.localizers.pointnet2 import FrustumPointNet2

    folder = shared / "golden" / "models"
    source = {}
    exec(compile((folder / "fill.py").read_text(), "fill.py", "exec"), source)
    shapes = json.loads((folder / f"frustum_pointnet_{name}.shapes.json").read_text())
    state = {key: torch.from_numpy(np.asarray(value)) for key, value in source["fill_state_dict"](shapes).items()}
    spec = LocalizerSpec.of("v2", dataset)
    network = FrustumPointNet2(spec)
    network.load_state_dict(state)
    return network.eval(), spec, state, np.load(folder / f"frustum_pointnet_{name}.npz")


@pytest.mark.real
@pytest.mark.parametrize(("name", "dataset"), [("kitti", "kitti"), ("nus", "nuscenes")])
def test_every_output_and_box_of_the_authors_network(shared, name, dataset):
    network, spec, _, arrays = golden_network(shared, name, dataset)
    for i in range(4):
        points = arrays[f"{i}.points"][arrays[f"{i}.sampled_indices"]].T[None].astype(np.float32)
        with torch.inference_mode():
            found = network(torch.from_numpy(points.copy()), torch.from_numpy(arrays[f"{i}.one_hot"]).float())
        logits = arrays[f"{i}.seg_logits"]
        np.testing.assert_allclose(found.mask.numpy(), logits[:, 1] - logits[:, 0], atol=1e-4)
        coarse = arrays[f"{i}.seg_center"] + arrays[f"{i}.tnet_center"]
        np.testing.assert_allclose(found.coarse.numpy(), coarse, atol=1e-4)
        parts = split_outputs(found.box.numpy(), len(spec.class_names))
        for part, key in zip(parts, PARTS, strict=True):
            np.testing.assert_allclose(part.reshape(arrays[f"{i}.{key}"].shape), arrays[f"{i}.{key}"], atol=1e-4)
        box = decode_boxes(found.centre.double().numpy(), found.box.numpy(), spec)
        expected = arrays[f"{i}.box_bottom_centre"].astype(np.float64)
        expected[:, 2] += expected[:, 5] / 2
        np.testing.assert_allclose(box, expected, atol=1e-4)


@pytest.mark.real
def test_a_checkpoint_file_of_that_form_localizes(shared, tmp_path):
    from lcf3d.localizers.torch_localizer import TorchLocalizer
    from tests.localizers.scenes import street_proposals

    _, spec, state, _ = golden_network(shared, "kitti", "kitti")
    torch.save({"state_dict": {f"frustum_localizer.{k}": v for k, v in state.items()}}, tmp_path / "authors.pth")
    localizer = TorchLocalizer(tmp_path / "authors.pth")
    assert localizer.spec == spec
    boxes, quality = localizer(street_proposals())
    assert np.isfinite(boxes).all()
    assert ((quality >= 0) & (quality <= 1)).all()


def test_other_checkpoints_are_refused_by_the_parameter_that_does_not_fit(tmp_path):
    from lcf3d.localizers.pointnet2 import FrustumPointNet2
    from lcf3d.localizers.torch_localizer import TorchLocalizer

    path = tmp_path / "wrong.pth"
    torch.save({"conv.weight": torch.zeros(3)}, path)
    with pytest.raises(DetectorError, match=r"no parameter 'output_fc\.weight'"):
        TorchLocalizer(path)
    state = FrustumPointNet2(LocalizerSpec.of("v2", "kitti")).state_dict()
    torch.save({**state, "output_fc.weight": torch.zeros(50, 256)}, path)
    with pytest.raises(DetectorError, match=r"has 50 rows, expected 39 \(kitti\) or 67 \(nuscenes\)"):
        TorchLocalizer(path)
    torch.save({**state, "tnet.fc1.weight": torch.zeros(256, 7)}, path)
    with pytest.raises(DetectorError, match=r"tnet\.fc1\.weight \(expected \(256, 259\), got \(256, 7\)\)"):
        TorchLocalizer(path)
