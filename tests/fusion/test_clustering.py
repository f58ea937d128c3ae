import itertools

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcf3d.fusion.clustering import SUPPRESSED, cluster_boxes
from lcf3d.geometry.iou import bev_iou
from tests.fusion.scenes import car


def crowd(seed, n=40, spread=6.0, ties=False):
    rng = np.random.default_rng(seed)
    boxes = np.column_stack(
        [rng.uniform(-spread, spread, (n, 2)), np.zeros(n), rng.uniform(1, 5, (n, 3)), rng.uniform(-3, 3, n)]
    )
    scores = rng.choice([0.2, 0.5, 0.8], n) if ties else rng.uniform(0, 1, n)
    return boxes, scores, rng.integers(0, 3, n)


def graph(boxes, labels, threshold, class_aware):
    g = nx.Graph()
    g.add_nodes_from(range(len(boxes)))
    iou = bev_iou(boxes, boxes)
    for i, j in itertools.combinations(range(len(boxes)), 2):
        if iou[i, j] > threshold and (not class_aware or labels[i] == labels[j]):
            g.add_edge(i, j)
    return g


def groups(index):
    return {frozenset(np.flatnonzero(index == c).tolist()) for c in range(index.max() + 1)}


def greedy_cliques(boxes, scores, g):
    """The rule of docs/method.md in plain Python."""
    free = sorted(range(len(boxes)), key=lambda i: -scores[i])
    clusters = []
    while free:
        members = [free.pop(0)]
        for j in list(free):
            if all(g.has_edge(j, m) for m in members):
                members.append(j)
                free.remove(j)
        clusters.append(members)
    return clusters


@pytest.mark.parametrize("class_aware", [False, True])
@pytest.mark.parametrize("seed", range(8))
def test_cliques_are_the_greedy_partition(seed, class_aware):
    boxes, scores, labels = crowd(seed)
    clusters = cluster_boxes(boxes, scores, labels, iou_threshold=0.2, class_aware=class_aware)
    g = graph(boxes, labels, 0.2, class_aware)
    expected = greedy_cliques(boxes, scores, g)
    assert groups(clusters.index) == {frozenset(c) for c in expected}
    assert clusters.representative.tolist() == [c[0] for c in expected]  # numbered by descending score
    for members in groups(clusters.index):
        assert all(g.has_edge(i, j) for i, j in itertools.combinations(members, 2))


@pytest.mark.parametrize("seed", range(8))
def test_components_equal_networkx(seed):
    boxes, scores, labels = crowd(seed)
    clusters = cluster_boxes(boxes, scores, labels, method="components", iou_threshold=0.1)
    expected = {frozenset(c) for c in nx.connected_components(graph(boxes, labels, 0.1, False))}
    assert groups(clusters.index) == expected
    for c, representative in enumerate(clusters.representative):
        members = np.flatnonzero(clusters.index == c)
        assert scores[representative] == scores[members].max()


@pytest.mark.parametrize("seed", range(8))
def test_nms_equals_brute_force(seed):
    boxes, scores, labels = crowd(seed)
    clusters = cluster_boxes(boxes, scores, labels, method="nms", iou_threshold=0.15)
    kept = []
    for i in np.argsort(-scores):
        if not kept or (bev_iou(boxes[[i]], boxes[kept])[0] <= 0.15).all():
            kept.append(i)
    assert clusters.representative.tolist() == kept
    assert (np.flatnonzero(clusters.index != SUPPRESSED) == np.sort(kept)).all()


@given(st.integers(0, 500), st.sampled_from(["cliques", "components", "nms"]), st.booleans())
@settings(max_examples=60, deadline=None)
def test_result_does_not_depend_on_input_order(seed, method, ties):
    boxes, scores, labels = crowd(seed, n=25, ties=ties)
    shuffle = np.random.default_rng(seed + 1).permutation(len(boxes))
    plain = cluster_boxes(boxes, scores, labels, method=method)
    shuffled = cluster_boxes(boxes[shuffle], scores[shuffle], labels[shuffle], method=method)
    np.testing.assert_array_equal(shuffled.index, plain.index[shuffle])
    np.testing.assert_array_equal(shuffle[shuffled.representative], plain.representative)


def test_a_chain_is_one_component_but_two_cliques():
    # neighbours overlap by more than 0.3, the ends do not: 4 m long boxes 1.6 m apart
    boxes = np.array([car(0), car(1.6), car(3.2)])
    scores, labels = np.array([0.9, 0.8, 0.7]), np.zeros(3, int)
    assert cluster_boxes(boxes, scores, labels, method="components").index.tolist() == [0, 0, 0]
    assert cluster_boxes(boxes, scores, labels, method="cliques").index.tolist() == [0, 0, 1]


def test_the_threshold_is_exclusive():
    # 4 m boxes 2 m apart share a third
    boxes, scores, labels = np.array([car(0), car(2.0)]), np.array([0.9, 0.8]), np.zeros(2, int)
    third = float(bev_iou(boxes[:1], boxes[1:])[0, 0])
    assert len(cluster_boxes(boxes, scores, labels, iou_threshold=third)) == 2
    assert len(cluster_boxes(boxes, scores, labels, iou_threshold=third - 1e-9)) == 1


def test_far_spread_boxes_and_one_spot():
    rng = np.random.default_rng(0)
    far = np.column_stack([rng.permutation(400) * 10.0, np.zeros((400, 2)), np.ones((400, 3)), np.zeros(400)])
    assert len(cluster_boxes(far, rng.uniform(0, 1, 400), np.zeros(400, int))) == 400
    spot = np.tile([car(5)], (300, 1))
    assert len(cluster_boxes(spot, rng.uniform(0, 1, 300), np.zeros(300, int))) == 1


def test_no_boxes():
    clusters = cluster_boxes(np.zeros((0, 7)), np.zeros(0), np.zeros(0, int))
    assert len(clusters) == 0
    assert clusters.index.shape == (0,)
