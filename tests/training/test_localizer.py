from dataclasses import replace

import numpy as np
import pytest

from lcf3d.errors import ConfigError, DatasetError
from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.localizers.frustum_inputs import network_inputs
from lcf3d.localizers.spec import LocalizerSpec, decode_boxes
from lcf3d.structures import KITTI_CLASSES
from lcf3d.training.frustum_batch import NO_AUGMENTATION, Augmentation, assemble, draw
from lcf3d.training.frustums import LabelledScene, collect, turned_scene
from tests.localizers.scenes import camera, propose, scan, standing

torch = pytest.importorskip("torch")

from lcf3d.localizers.pointnet import FrustumOutputs  # noqa: E402
from lcf3d.training.localizer import LocalizerTask, LossWeights, corner_distance, frustum_losses  # noqa: E402
from lcf3d.training.loop import TrainingSettings, train  # noqa: E402

SPEC = LocalizerSpec.of("v1", "kitti")
LABELS = {name: k for k, name in enumerate(SPEC.class_names)}


def street(seed=0):
    """A scan of a few cars and people with their boxes."""
    rng = np.random.default_rng(seed)
    boxes = [standing(10 + 8 * k, rng.uniform(-3, 3), 4, 1.6, 1.5, rng.uniform(-3, 3)) for k in range(2)]
    boxes += [standing(7 + 5 * k, 3 + k, 0.8, 0.6, 1.75, rng.uniform(-3, 3)) for k in range(2)]
    names = np.array(["Car", "Car", "Pedestrian", "Cyclist"])
    return LabelledScene(scan(boxes, seed=seed), np.array(boxes), names, camera(), camera())


@pytest.fixture(scope="module")
def pool():
    return collect((street(seed) for seed in range(4)), LABELS, seed=0)


def test_a_pooled_frustum_makes_the_proposal_that_inference_makes():
    scene = street()
    (frustum,) = [f for f in collect([scene], LABELS, 0) if f.label == LABELS["Pedestrian"] and not f.empty]
    sample = draw(frustum, True, NO_AUGMENTATION, np.random.default_rng(0))
    proposals = propose(scene.points, scene.boxes[2:3], [KITTI_CLASSES.index("Pedestrian")])
    order, expected = np.lexsort(sample.points.T), np.lexsort(proposals.points.T)
    np.testing.assert_allclose(sample.points[order], proposals.points[expected], atol=1e-5)
    np.testing.assert_allclose(sample.gaussian[order], proposals.gaussian[expected], atol=1e-5)
    np.testing.assert_allclose(sample.box, proposals.frustum_from_lidar(scene.boxes[2:3])[0], atol=1e-9)
    np.testing.assert_array_equal(sample.inside, points_in_boxes(sample.points, sample.box[None])[0])
    batch = assemble([sample], SPEC, np.random.default_rng(0))
    inputs = network_inputs(proposals, np.array([LABELS["Pedestrian"]]), SPEC)
    np.testing.assert_allclose(batch["context"], inputs.context, atol=1e-6)
    np.testing.assert_allclose(batch["reference"], inputs.reference, rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_augmentation_moves_points_and_box_together(pool, seed):
    rng = np.random.default_rng(seed)
    for frustum in pool:
        sample = draw(frustum, False, Augmentation(stereo=0.3, mask=0.3, on_mask=0.3), rng)
        assert np.isfinite(sample.points).all()
        if frustum.empty:
            assert not sample.inside.any()
            continue
        # a tilt shears the box's points by a few millimetres at most
        grown = sample.box + np.array([0, 0, 0, 0.1, 0.1, 0.1, 0])
        assert points_in_boxes(sample.points, grown[None])[0][sample.inside].all()


def test_what_nobody_has_labelled_is_no_frustum_of_nothing():
    wide = np.array([[-2000.0, -2000.0, 4000.0, 4000.0]])  # a region much larger than any box in it
    free = collect((street(seed) for seed in range(20)), LABELS, seed=0)
    unknown = collect((replace(street(seed), unknown2d=wide) for seed in range(20)), LABELS, seed=0)
    assert sum(f.empty for f in free) > 3
    assert not any(f.empty for f in unknown)
    assert sum(not f.empty for f in unknown) == sum(not f.empty for f in free)


def test_turning_the_car_keeps_points_in_their_boxes():
    scene = street()
    turned = turned_scene(scene, 1.1)
    np.testing.assert_array_equal(
        points_in_boxes(turned.points, turned.boxes), points_in_boxes(scene.points, scene.boxes)
    )


def perfect(batch, spec):
    """What a network would say that knows everything."""
    n = len(batch["label"])
    box = torch.full((n, spec.outputs), -8.0)
    rows, classes = torch.arange(n), len(spec.class_names)
    templates = torch.tensor(spec.templates, dtype=torch.float32)[batch["label"]]
    box[:, :3] = 0
    for axis in range(3):
        box[rows, 3 + 3 * batch["label"] + axis] = batch["size"][:, axis] / templates[:, axis] - 1
    box[rows, 3 + 3 * classes + batch["label"]] = 12.0
    box[rows, 3 + 4 * classes + batch["heading"]] = batch["heading_residual"]
    box[rows, 3 + 4 * classes + 12 + batch["heading"]] = 12.0
    quality = torch.where(batch["real"] > 0, 12.0, -12.0)
    return FrustumOutputs((batch["mask"] - 0.5) * 40, batch["centre"], batch["centre"], box, quality)


def test_the_loss_of_a_perfect_answer_is_nothing_and_its_box_the_label(pool):
    task = LocalizerTask(SPEC, pool, [], batch_size=8)
    batch = task.batch(0, np.random.default_rng(0))
    outputs = perfect(batch, SPEC)
    terms = frustum_losses(outputs, batch, SPEC, LossWeights())
    assert set(terms) == set(vars(LossWeights()))
    assert max(float(v) for v in terms.values()) < 1e-3
    boxes = decode_boxes(outputs.centre.double().numpy(), outputs.box.numpy(), SPEC)
    real = batch["real"].numpy() > 0
    np.testing.assert_allclose(boxes[real, 3:6], batch["size"].numpy()[real], rtol=1e-5)
    worse = outputs._replace(centre=outputs.centre + 1)
    assert float(frustum_losses(worse, batch, SPEC, LossWeights())["corners"]) > 0.5


def test_corners_of_a_box_turned_by_half_a_turn_are_as_good():
    centre, size, yaw = torch.zeros(1, 3), torch.tensor([[4.0, 2.0, 1.5]]), torch.tensor([0.3])
    assert float(corner_distance(centre, size, yaw + torch.pi, centre, size, yaw)) < 1e-5
    # one metre along x: Huber of 1 with delta 1 is a half
    moved = centre + torch.tensor([[1.0, 0, 0]])
    assert float(corner_distance(moved, size, yaw, centre, size, yaw)) == pytest.approx(0.5, abs=1e-5)


@pytest.mark.parametrize("form", ["v1", "v2"])
def test_both_forms_learn_and_resume_as_if_nothing_had_happened(pool, tmp_path, form):
    task = LocalizerTask(LocalizerSpec.of(form, "kitti"), pool, pool[:2], batch_size=2)
    settings = TrainingSettings(4, 3e-3, checkpoint_every=2)
    losses = []
    whole = train(task, settings, tmp_path / "whole", report=lambda p: losses.append(p.loss))
    assert np.isfinite(losses).all()

    def stop(progress):
        if progress.step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(task, settings, tmp_path / "cut", report=stop)
    resumed = train(task, settings, tmp_path / "cut", resume=True)
    for a, b in zip(whole.state_dict().values(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b)
    figures = task.validate(whole)
    assert 0 <= figures["Car IoU"] <= 1


def test_the_exported_network_is_the_network(pool, tmp_path):
    pytest.importorskip("onnx")
    from lcf3d.localizers.onnx import OnnxLocalizer
    from lcf3d.localizers.pointnet import FrustumPointNet, export_onnx

    torch.manual_seed(0)
    network = FrustumPointNet(SPEC).eval()
    export_onnx(network, SPEC, tmp_path / "localizer.onnx")
    localizer = OnnxLocalizer(tmp_path / "localizer.onnx")
    assert localizer.spec == SPEC
    scene = street()
    proposals = propose(scene.points, scene.boxes, [0, 0, 1, 2])
    inputs = network_inputs(proposals, np.array([2, 2, 0, 1]), SPEC)
    with torch.inference_mode():
        found = network(torch.from_numpy(inputs.points), torch.from_numpy(inputs.context))
    expected = decode_boxes(inputs.reference + found.centre.double().numpy(), found.box.numpy(), SPEC)
    boxes, quality = localizer(proposals)
    np.testing.assert_allclose(boxes, expected, atol=1e-4)
    np.testing.assert_allclose(quality, torch.sigmoid(found.quality).numpy(), atol=1e-4)


def test_data_without_frustums_and_senseless_settings_are_refused(pool):
    with pytest.raises(DatasetError, match="no frustum to train on: no object of Tram"):
        collect([street()], {"Tram": 0}, 0)
    with pytest.raises(ConfigError, match="two frustums or more"):
        LocalizerTask(SPEC, pool, [], batch_size=1)
    with pytest.raises(ConfigError, match="shares name 'Bus'"):
        LocalizerTask(SPEC, pool, [], shares={"Bus": 1.0})
