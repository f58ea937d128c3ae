"""The compiled matching against a slow, plain reading of the benchmark's rules."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import Polygon, box

from lcf3d.evaluation.curves import precision_curve
from lcf3d.evaluation.kitti import DIFFICULTIES, KittiEvaluator, Selection
from lcf3d.evaluation.kitti_matching import BELOW, FALSE_POSITIVE, NOT_COUNTED, TRUE_POSITIVE
from lcf3d.formats.kitti import KittiObjects
from tests.evaluation.kitti_frames import dontcare, frames


def rectangle(objects: KittiObjects, i: int) -> Polygon:
    _, width, length = np.abs(objects.dimensions[i])
    x, _, z = objects.locations[i]
    flat = box(-length / 2, -width / 2, length / 2, width / 2)
    # rotation_y turns from camera x towards -z
    return affinity.translate(affinity.rotate(flat, -objects.rotation_y[i], origin=(0, 0), use_radians=True), x, z)


def slow_overlap(measure: str, truth: KittiObjects, i: int, results: KittiObjects, j: int) -> float:
    covered_share = truth.class_names[i] == "DontCare"
    if measure == "bbox":
        a, b = box(*truth.boxes2d[i]), box(*results.boxes2d[j])
        shared, size_a, size_b = a.intersection(b).area, a.area, b.area
    else:
        a, b = rectangle(truth, i), rectangle(results, j)
        shared, size_a, size_b = a.intersection(b).area, a.area, b.area
        if measure == "3d":
            top = max(
                truth.locations[i, 1] - truth.dimensions[i, 0], results.locations[j, 1] - results.dimensions[j, 0]
            )
            bottom = min(truth.locations[i, 1], results.locations[j, 1])
            shared *= max(0, bottom - top)
            size_a, size_b = size_a * truth.dimensions[i, 0], size_b * results.dimensions[j, 0]
    return float(shared / (size_b if covered_share else size_a + size_b - shared))


def slow_statistics(overlap, truth, results, codes_a, codes_b, threshold, min_overlap):  # type: ignore[no-untyped-def]
    """True positives' scores, false positives and similarity of one frame; no threshold for the recall pass."""
    assigned: set[int] = set()
    hits, similarity = [], 0.0
    usable = [j for j in range(len(results)) if codes_b[j] != -1]
    if threshold is not None:
        usable = [j for j in usable if results.scores[j] >= threshold]
    for i in range(len(truth)):
        if codes_a[i] == -1:
            continue
        free = [j for j in usable if j not in assigned and overlap[i, j] > min_overlap]
        if not free:
            continue
        if threshold is None:
            chosen = max(free, key=lambda j: (results.scores[j], -j))
        else:
            proper = [j for j in free if codes_b[j] == 0]
            chosen = max(proper, key=lambda j: (overlap[i, j], -j)) if proper else free[0]
        assigned.add(chosen)
        if codes_a[i] == 0 and codes_b[chosen] == 0:
            hits.append(float(results.scores[chosen]))
            similarity += (1 + np.cos(truth.alpha[i] - results.alpha[chosen])) / 2
    wrong = [j for j in usable if j not in assigned and codes_b[j] == 0]
    regions = [i for i in range(len(truth)) if truth.class_names[i] == "DontCare"]
    wrong = [j for j in wrong if not any(overlap[i, j] > min_overlap for i in regions)]
    return hits, len(wrong), similarity


def slow_curve(evaluator: KittiEvaluator, selection: Selection) -> tuple[list[float], list[float]]:
    min_overlap = evaluator.config.min_overlap[selection.class_name][selection.measure]
    codes_a, codes_b = evaluator.codes(selection)
    parts = []
    for f, (truth, results) in enumerate(zip(evaluator.truth, evaluator.results, strict=True)):
        overlap = np.array(
            [
                [slow_overlap(selection.measure, truth, i, results, j) for j in range(len(results))]
                for i in range(len(truth))
            ]
        )
        rows, columns = evaluator.truth.starts[f : f + 2], evaluator.results.starts[f : f + 2]
        parts.append((overlap, truth, results, codes_a[slice(*rows)], codes_b[slice(*columns)]))
    found = sorted((s for part in parts for s in slow_statistics(*part, None, min_overlap)[0]), reverse=True)
    n_objects = int((codes_a == 0).sum())
    thresholds, recall = [], 0.0
    for i, score in enumerate(found):
        left = (i + 1) / n_objects
        right = (i + 2) / n_objects if i + 1 < len(found) else left
        if right - recall < recall - left and i + 1 < len(found):
            continue
        thresholds.append(score)
        recall += 1 / 40
    precision, similarity = np.zeros(41), np.zeros(41)
    for k, threshold in enumerate(thresholds):
        stats = [slow_statistics(*part, threshold, min_overlap) for part in parts]
        hits, wrong = sum(len(s[0]) for s in stats), sum(s[1] for s in stats)
        if hits + wrong:
            precision[k] = hits / (hits + wrong)
            similarity[k] = sum(s[2] for s in stats) / (hits + wrong)
    return [max(precision[k:]) for k in range(41)], [max(similarity[k:]) for k in range(41)]


def random_frames(rng: np.random.Generator, results: bool, n_frames: int) -> list[list[dict[str, object]]]:
    names = ["Car", "Car", "Car", "Van", "Pedestrian", "Cyclist"] + ([] if results else ["DontCare"])
    made = []
    for _ in range(n_frames):
        rows: list[dict[str, object]] = []
        for _ in range(rng.integers(0, 7)):
            x, y, height = rng.integers(0, 3) * 20.0, rng.integers(0, 2) * 15.0, float(rng.choice([20, 25, 30, 40, 60]))
            row: dict[str, object] = dontcare((x, y, x + 60, y + height))
            if (name := rng.choice(names)) != "DontCare":
                row = {
                    "name": name,
                    "truncated": rng.choice([0, 0, 0.15, 0.3, 0.4, 0.6]),
                    "occluded": rng.choice([0, 0, 1, 2, 3]),
                    "alpha": rng.uniform(-3, 3),
                    "box": (x, y, x + 60, y + height),
                    "size": (rng.uniform(1.4, 1.6), rng.uniform(1.8, 2.2), rng.uniform(3.8, 4.2)),
                    "location": (rng.normal(0, 0.3), 1.5 + rng.normal(0, 0.1), 10 + rng.normal(0, 0.3)),
                    "rotation": rng.normal(0, 0.1),
                    # few different scores, so that ties are common
                    "score": rng.integers(0, 6) / 5,
                }
            rows.append(row)
        made.append(rows)
    return made


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_curves_equal_a_plain_reading_of_the_rules(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n_frames = int(rng.integers(1, 6))
    evaluator = KittiEvaluator(
        frames(random_frames(rng, False, n_frames), results=False),
        frames(random_frames(rng, True, n_frames), results=True),
    )
    for measure in ("bbox", "bev", "3d"):
        selection = Selection("Car", measure, DIFFICULTIES[rng.integers(3)])  # type: ignore[arg-type]
        precision, similarity = precision_curve(evaluator.events(selection))
        expected_precision, expected_similarity = slow_curve(evaluator, selection)
        np.testing.assert_allclose(precision.precision, expected_precision, atol=1e-12)
        if measure == "bbox":
            np.testing.assert_allclose(similarity.precision, expected_similarity, atol=1e-12)


def fate(
    truth: list[dict[str, object]], results: list[dict[str, object]], threshold: float = 0.0
) -> tuple[list[int], list[int]]:
    evaluator = KittiEvaluator(frames([truth], results=False), frames([results], results=True))
    matches, outcomes = evaluator.match_at(Selection("Car", "bbox", "easy"), threshold)
    return matches.tolist(), outcomes.tolist()


def test_the_fate_of_each_detection() -> None:
    far_right = (200, 0, 300, 50)
    assert fate([{}], [{}]) == ([0], [TRUE_POSITIVE])
    assert fate([{}], [{"box": far_right}]) == ([-1], [FALSE_POSITIVE])
    assert fate([{}], [{"score": 0.4}], threshold=0.5) == ([-1], [BELOW])
    # the neighbouring class is neither right nor wrong, a truck is wrong
    assert fate([{"name": "Van"}], [{}]) == ([0], [NOT_COUNTED])
    assert fate([{"name": "Truck"}], [{}]) == ([-1], [FALSE_POSITIVE])
    # the same for an object too hard for the difficulty
    assert fate([{"occluded": 2}], [{}]) == ([0], [NOT_COUNTED])
    # another class is not judged here
    assert fate([{}], [{"name": "Cyclist"}]) == ([-1], [NOT_COUNTED])
    # the second detection of one object is wrong
    assert fate([{}], [{"score": 0.5}, {"box": (0, 0, 100, 49)}]) == ([0], [TRUE_POSITIVE, FALSE_POSITIVE])


def test_dontcare_counts_the_share_of_the_detection() -> None:
    # the region is far greater than the detection: IoU is small, the covered share is 1
    assert fate([dontcare((0, 0, 1000, 1000))], [{}]) == ([-1], [NOT_COUNTED])
    # 60 of 100 columns covered: not more than 0.7
    assert fate([dontcare((40, 0, 1000, 1000))], [{}]) == ([-1], [FALSE_POSITIVE])


def test_a_detection_below_the_minimum_height_is_ignored_and_yields_to_a_proper_one() -> None:
    low, proper = {"box": (0, 0, 100, 39.5)}, {"box": (0, 0, 100, 45)}
    assert fate([{"box": (0, 0, 100, 40)}], [low]) == ([0], [NOT_COUNTED])
    assert fate([{"box": (0, 0, 100, 40)}], [low, proper]) == ([1], [NOT_COUNTED, TRUE_POSITIVE])
    # even when it is of another class: a rule of the official program
    assert fate([{"box": (0, 0, 100, 40)}], [{**low, "name": "Cyclist"}]) == ([0], [NOT_COUNTED])


def test_an_object_exactly_at_the_limits_counts() -> None:
    evaluator = KittiEvaluator(
        frames(
            [[{"box": (0, 0, 100, 40), "truncated": 0.15}, {"box": (0, 0, 100, 39.99)}, {"truncated": 0.16}]], False
        ),
        frames([[]], True),
    )
    assert evaluator.codes(Selection("Car", "bbox", "easy"))[0].tolist() == [0, 1, 1]
    assert evaluator.codes(Selection("Car", "bbox", "moderate"))[0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("rotation", [0.0, 0.3, np.pi / 2, -3.0])
def test_identical_boxes_overlap_fully(rotation: float) -> None:
    evaluator = KittiEvaluator(
        frames([[{"rotation": rotation, "location": (3.1, 1.7, 21.4)}]], False),
        frames([[{"rotation": rotation, "location": (3.1, 1.7, 21.4)}]], True),
    )
    for measure in ("bbox", "bev", "3d"):
        assert evaluator.overlap[measure][0] == pytest.approx(1, abs=1e-12)
