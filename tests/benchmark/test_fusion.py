import numpy as np

from lcf3d.benchmark.fusion import bench_fusion
from lcf3d.benchmark.reference import plain_matching
from lcf3d.benchmark.scenes import detections
from lcf3d.benchmark.timing import measure
from lcf3d.fusion.clustering import cluster_boxes
from lcf3d.fusion.matching import match_view


def test_the_reference_does_the_same_as_ours():
    frame, lidar, camera = detections(200, 20, seed=3)
    view = frame.cameras[0]
    clusters = cluster_boxes(lidar.boxes, lidar.scores, lidar.labels, iou_threshold=0.3)
    ours = match_view(lidar.boxes, clusters, view, camera.boxes, iou_threshold=0.4)
    members, match = plain_matching(lidar.boxes, lidar.scores, view, camera.boxes, 0.3, 0.4)
    assert [m[0] for m in members] == clusters.representative.tolist()
    assert all(set(np.flatnonzero(clusters.index == c)) == set(m) for c, m in enumerate(members))
    assert ours.match.tolist() == match.tolist()
    assert (match >= 0).sum() > 10


def test_every_stage_is_measured_beside_a_reference():
    timings = {t.name: t for t in bench_fusion(seconds=0.01)}
    assert len(timings) == 8
    assert timings["bounding box matching, 500 x 40"].speedup > 1
    assert all(t.median_ms >= t.best_ms > 0 for t in timings.values())


def test_measure_counts_calls():
    calls = []
    _, _, repeats = measure(lambda: calls.append(1), seconds=0, least=4)
    assert (repeats, len(calls)) == (4, 5)
