"""Boxes, returns, masks, depths and disparities of simulated frames agree with one another."""

import numpy as np
import pytest

from lcf3d.geometry.boxes import points_in_boxes
from lcf3d.geometry.camera import project_boxes, project_points
from lcf3d.simulation.camera import camera_rays


def grown(boxes, margin):
    result = boxes.copy()
    result[:, 3:6] += 2 * margin
    return result


def test_a_box_holds_every_return_of_its_object(frames):
    checked = 0
    for frame in frames:
        inside = points_in_boxes(frame.scan.points, grown(frame.boxes, 0.005))
        for k, actor in enumerate(frame.actors):
            own = frame.scan.owner == actor.id
            assert inside[k, own].all(), (actor.kind, actor.id)
            checked += own.sum()
    assert checked > 500


def test_a_box_holds_nothing_of_the_ground_or_of_its_neighbours(frames):
    for frame in frames:
        boxes = grown(frame.boxes, -0.05)  # the land may rise by this much under a long vehicle
        inside = points_in_boxes(frame.scan.points, boxes)
        for k, actor in enumerate(frame.actors):
            assert (frame.scan.owner[inside[k]] == actor.id).all(), (actor.kind, actor.id)


def test_every_pixel_of_a_mask_lies_in_the_box_at_its_depth(frames):
    checked = 0
    for frame in frames:
        for camera in frame.preset.cameras:
            render = frame.renders[camera.name]
            rows, columns = np.nonzero(render.owner)
            origin, direction = camera_rays(camera, np.eye(4), columns + 0.5, rows + 0.5)
            ahead = direction @ camera.camera_from_lidar[2, :3]
            points = origin + direction * (render.depth[rows, columns] / ahead)[:, None]
            for k, actor in enumerate(frame.actors):
                own = render.owner[rows, columns] == actor.id
                # a single-precision ray meets a far surface to about a centimetre
                assert points_in_boxes(points[own], grown(frame.boxes[k : k + 1], 0.02)).all()
                checked += own.sum()
    assert checked > 2000


def test_visible_extent_lies_in_the_projected_box_and_fills_it_when_nothing_hides_it(frames):
    full = 0
    for frame in frames:
        for camera in frame.preset.cameras:
            seen = frame.sightings[camera.name]
            projected, _ = project_boxes(frame.boxes, camera)
            for k in np.flatnonzero(seen.pixels):
                assert (seen.boxes2d[k, :2] >= projected[k, :2] - 1).all()
                assert (seen.boxes2d[k, 2:] <= projected[k, 2:] + 1).all()
                if seen.hidden[k] < 0.01 and frame.actors[k].kind in ("car", "van", "truck"):
                    size = projected[k, 2:] - projected[k, :2]
                    assert (np.abs(seen.boxes2d[k] - projected[k]) <= 2.0 + 0.25 * np.tile(size, 2)).all()
                    full += 1
    assert full > 3


def test_projected_returns_fall_on_the_mask_of_their_object(frames):
    same = total = 0
    for frame in frames:
        camera = frame.preset.cameras[0]
        render = frame.renders[camera.name]
        pixels, depth = project_points(frame.scan.points, camera)
        u, v = np.floor(np.nan_to_num(pixels, nan=-1)).astype(int).T
        inside = (depth > 1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        own = inside & (frame.scan.owner > 0)
        at_depth = np.abs(render.depth[v[own], u[own]] - depth[own]) < 0.1
        same += (render.owner[v[own], u[own]] == frame.scan.owner[own])[at_depth].sum()
        total += at_depth.sum()
    assert total > 200
    assert same / total > 0.97


def test_stereo_disparity_is_focal_length_times_baseline_over_depth(frames):
    for frame in frames:
        left, right = frame.preset.cameras
        baseline = (left.projection[0, 3] - right.projection[0, 3]) / left.projection[0, 0]
        assert baseline == pytest.approx(0.5327, abs=1e-3)
        depth, other = frame.renders["left"].depth, frame.renders["right"].depth
        rows, columns = np.nonzero(np.isfinite(depth) & (depth < 40))
        z = depth[rows, columns]
        u = columns + 0.5 - left.projection[0, 0] * baseline / z
        kept = u >= 0
        rows, columns, z, u = rows[kept], columns[kept], z[kept], np.floor(u[kept]).astype(int)
        agrees = np.abs(other[rows, u] - z) < 0.04 * z
        owner_agrees = frame.renders["right"].owner[rows, u] == frame.renders["left"].owner[rows, columns]
        assert agrees.mean() > 0.85  # the rest is hidden from one of the two, or slants within a pixel
        assert owner_agrees[agrees].mean() > 0.98


def test_nuscenes_boxes_hold_their_returns_and_pixels(nuscenes_frame):
    frame = nuscenes_frame
    inside = points_in_boxes(frame.scan.points, grown(frame.boxes, 0.005))
    for k, actor in enumerate(frame.actors):
        assert inside[k, frame.scan.owner == actor.id].all()
    seen = {name: int((s.pixels > 0).sum()) for name, s in frame.sightings.items()}
    assert len(seen) == 6
    assert sum(seen.values()) > 5
    for camera in frame.preset.cameras:
        _, visible = project_boxes(frame.boxes, camera)
        assert visible[frame.sightings[camera.name].pixels > 0].all()


def test_tracks_keep_their_ids_and_move_with_their_speed(drive):
    first, last = drive[0], drive[2]
    assert [a.id for a in first.actors] == [a.id for a in last.actors]
    world_first, world_last = first.scene.boxes(0.0), first.scene.boxes(0.2)
    moved = np.linalg.norm(world_last[:, :2] - world_first[:, :2], axis=1)
    speeds = np.array([abs(a.motion.speed) for a in first.actors])
    np.testing.assert_allclose(moved, speeds * 0.2, rtol=0.05, atol=0.01)
    assert (speeds > 1).any()
    assert last.time == pytest.approx(0.2)
    ego = np.linalg.norm(last.world_from_lidar[:2, 3] - first.world_from_lidar[:2, 3])
    assert ego == pytest.approx(first.scene.ego.speed * 0.2, rel=0.02, abs=1e-3)
