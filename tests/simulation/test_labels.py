import numpy as np
import pytest

from lcf3d.errors import ConfigError
from lcf3d.formats.kitti import detections_3d
from lcf3d.geometry.camera import project_boxes
from lcf3d.geometry.iou import image_iou
from lcf3d.simulation.frames import attribute, simulate_frame
from lcf3d.simulation.labels import occlusion_level
from lcf3d.simulation.sizes import KITTI_SIZES, NUSCENES_SIZES, draw_size
from lcf3d.structures import KITTI_CLASSES

from .conftest import tiny


def test_occlusion_levels_at_their_limits():
    hidden = np.array([0.0, 0.119, 0.12, 0.49, 0.5, 0.89, 0.9, 1.0])
    assert occlusion_level(hidden).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_kitti_labels_give_back_the_boxes(frames):
    for frame in frames:
        labels = detections_3d(frame.kitti, frame.preset.cameras[0].camera_from_lidar, KITTI_CLASSES)
        assert len(labels)
        for box in labels.boxes:
            gap = np.abs(frame.boxes[:, :6] - box[:6]).max(axis=1)
            assert gap.min() < 1e-9


def test_clear_labels_have_boxes_that_fit_the_projection(frames):
    for frame in frames:
        objects, camera = frame.kitti, frame.preset.cameras[0]
        clear = (objects.occluded == 0) & (objects.truncated == 0) & (objects.class_names == "Car")
        boxes = detections_3d(objects[clear], camera.camera_from_lidar, ("Car",)).boxes
        projected, _ = project_boxes(boxes, camera)
        if len(boxes):
            assert np.diag(image_iou(projected, objects.boxes2d[clear])).min() > 0.55


def test_boxes_of_people_are_narrower_than_their_projection_and_those_of_cars_are_not(frames):
    shares = {"pedestrian": [], "car": []}
    for frame in frames:
        camera = frame.preset.cameras[0]
        projected, seen = project_boxes(frame.boxes, camera)
        for k in np.flatnonzero(seen):
            kind, box = frame.actors[k].kind, frame.sightings["left"].amodal[k]
            whole = (projected[k, 0] > 0) & (projected[k, 2] < camera.width)
            if kind in shares and whole:
                shares[kind].append((box[2] - box[0]) / (projected[k, 2] - projected[k, 0]))
                np.testing.assert_allclose(box[[1, 3]], projected[k, [1, 3]])
    assert 0.5 < np.median(shares["pedestrian"]) < 0.85  # 0.68 in KITTI
    assert np.min(shares["car"]) == 1


def test_hidden_and_truncated_shares_follow_from_a_wall_and_an_image_border(frames):
    for frame in frames:
        seen = frame.sightings["left"]
        shown = seen.pixels > 0
        assert ((seen.hidden >= 0) & (seen.hidden <= 1)).all()
        cut = shown & (seen.truncated > 0.1)
        width, height = frame.preset.cameras[0].width, frame.preset.cameras[0].height
        for k in np.flatnonzero(cut & (seen.hidden < 0.1)):
            x1, y1, x2, y2 = seen.boxes2d[k]
            assert x1 == 0 or y1 == 0 or x2 == width or y2 == height


def test_perfect_camera_detections_have_masks_in_their_boxes(frames):
    found = 0
    for frame in frames:
        detections = frame.detections_2d("left")
        for box, mask in zip(detections.boxes, detections.masks, strict=True):
            assert mask.bitmap.shape == (box[3] - box[1], box[2] - box[0])
            assert mask.bitmap.any(axis=0).all() or mask.bitmap.sum() > 0
            assert mask.bitmap[0].any()
            assert mask.bitmap[-1].any()
            found += 1
    assert found > 3
    with pytest.raises(ConfigError, match="no image of camera 'top'"):
        frames[0].detections_2d("top")


def test_labels_without_images_say_what_is_missing():
    frame = simulate_frame(tiny("kitti64"), 0, 1, images=False)
    assert frame.frame.labels is None
    with pytest.raises(ConfigError, match="images=True"):
        _ = frame.kitti


def test_nuscenes_labels_have_velocities_and_attributes(nuscenes_frame):
    labels = nuscenes_frame.labels
    assert (nuscenes_frame.points_on[nuscenes_frame.points_on > 0] > 0).sum() == len(labels)
    speeds = {round(abs(a.motion.speed), 3) for a in nuscenes_frame.actors}
    for velocity in labels.velocities:
        assert min(abs(np.hypot(*velocity) - s) for s in speeds) < 0.05 * max(speeds) + 1e-6
    for actor in nuscenes_frame.actors:
        name = attribute(actor)
        assert (name == "") == (actor.kind in ("cone", "barrier"))
        if actor.kind == "pedestrian":
            assert name == ("pedestrian.moving" if actor.motion.speed else "pedestrian.standing")


@pytest.mark.parametrize("name", [*KITTI_SIZES, *NUSCENES_SIZES])
def test_sizes_follow_their_table(name):
    rng = np.random.default_rng(0)
    drawn = np.array([draw_size(name, rng) for _ in range(300)])
    mean, deviation = (np.array(v) for v in {**KITTI_SIZES, **NUSCENES_SIZES}[name])
    assert (np.abs(drawn.mean(axis=0) - mean) < 0.3 * deviation + 0.05 * mean).all()
    assert (drawn > 0.1).all()


def test_unknown_class_is_refused():
    with pytest.raises(ConfigError, match="no sizes for class 'Dragon'"):
        draw_size("Dragon", np.random.default_rng(0))
