"""nuScenes' tracking metrics: a tiny world worked out by hand, bad files, and the numbers of the official devkit."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from lcf3d.cli.app import app
from lcf3d.datasets.nuscenes import NuscenesDataset
from lcf3d.errors import ConfigError, DatasetError, FormatError
from lcf3d.evaluation.nuscenes_tracking import MEASURES
from lcf3d.evaluation.opening import open_tracking
from lcf3d.evaluation.protocol import EvaluationOptions
from lcf3d.formats.nuscenes import TRACKING_CLASSES
from tests.datasets.nuscenes_world import SAMPLES, world_tables, write_world

# of the car, metres, sample by sample
PLACES = ([120.0, 50.0, 1.0], [121.5, 52.0, 1.0], [123.0, 54.0, 1.0])


def box(sample, track="a", name="car", place=None, score=0.9, **changes):
    return {
        "sample_token": SAMPLES[sample],
        "translation": PLACES[sample] if place is None else place,
        "size": [2.0, 4.0, 1.5],
        "rotation": [1.0, 0.0, 0.0, 0.0],
        "velocity": [0.0, 0.0],
        "tracking_id": track,
        "tracking_name": name,
        "tracking_score": score,
        **changes,
    }


def write(path, boxes, samples=SAMPLES):
    results = {token: [own for own in boxes if own["sample_token"] == token] for token in samples}
    path.write_text(json.dumps({"meta": {}, "results": results}))
    return path


@pytest.fixture
def measure(tmp_path):
    def measured(boxes, frame_ids=SAMPLES, missing="error", tables=None, samples=SAMPLES, classes=("car",)):
        data = NuscenesDataset(write_world(tmp_path / "world", tables))
        tracking = open_tracking(data, frame_ids, EvaluationOptions(classes=classes))
        return tracking.read(write(tmp_path / "tracking.json", boxes, samples), missing)

    return measured


def car(result):
    return result.metrics.classes["car"]


def test_the_truth_as_tracks_is_perfect(measure):
    own = car(measure([box(t) for t in range(3)]))
    assert (own["amota"], own["amotp"], own["mota"], own["motp"], own["recall"]) == pytest.approx((1, 0, 1, 0, 1))
    counts = {name: own[name] for name in ("gt", "tp", "fp", "fn", "ids", "frag", "mt", "ml", "tid", "lgd", "faf")}
    assert counts == {
        "gt": 3,
        "tp": 3,
        **dict.fromkeys(("fp", "fn", "ids", "frag"), 0),
        "mt": 1,
        "ml": 0,
    } | dict.fromkeys(("tid", "lgd", "faf"), 0)


def test_a_false_alarm_and_a_late_start_by_hand(measure):
    # found in two of three samples, 1 m beside, and one false alarm that is not in the way
    shifted = [[x, y + 1, z] for x, y, z in PLACES]
    boxes = [box(t, place=shifted[t]) for t in (1, 2)] + [box(0, "b", place=[130.0, 40.0, 1.0])]
    own = car(measure(boxes))
    assert (own["tp"], own["fn"], own["fp"]) == (2, 1, 1)
    assert own["mota"] == pytest.approx(1 - 2 / 3)
    # 2 right and 1 false alarm at the recall that is reached
    assert own["motar"] == pytest.approx(1 - 1 / 2)
    assert (own["motp"], own["recall"], own["tid"], own["lgd"]) == pytest.approx((1, 2 / 3, 0.5, 0.5))
    # recalls of 0.1, 0.1 + 0.9 / 39 ... up to 2/3 are reached: 25 of 40; for the others the worst counts
    assert own["amota"] == pytest.approx(25 / 40 * 0.5)
    assert own["amotp"] == pytest.approx((25 * 1 + 15 * 2) / 40)
    assert own["faf"] == pytest.approx(100 / 3)


def test_a_switch_counts_once_and_takes_a_match(measure):
    own = car(measure([box(0, "a"), box(1, "b"), box(2, "b")]))
    assert (own["tp"], own["ids"], own["fn"], own["fp"]) == (2, 1, 0, 0)
    assert own["recall"] == 1
    assert own["mota"] == pytest.approx(2 / 3)


def test_holes_in_a_track_are_filled(measure):
    own = car(measure([box(0), box(2)]))
    assert (own["tp"], own["fn"], own["frag"]) == (3, 0, 0)
    assert own["motp"] == pytest.approx(0, abs=1e-9)
    # two tracks leave the hole: the object is lost and found again
    own = car(measure([box(0, "a"), box(2, "b")]))
    assert (own["tp"], own["fn"], own["ids"], own["frag"], own["lgd"]) == (1, 1, 1, 1, 0.5)


def test_two_metres_are_too_far(measure):
    def beside(y):
        return car(measure([box(t, place=np.add(PLACES[t], [0, y, 0]).tolist()) for t in range(3)]))

    assert beside(1.99)["tp"] == 3
    nothing = beside(2.0)
    assert (nothing["mota"], nothing["amota"], nothing["amotp"], nothing["fn"], nothing["ml"]) == (0, 0, 2, 3, 1)
    assert np.isnan(nothing["fp"])


def test_classes_without_objects_and_all_together(measure):
    result = measure([box(t) for t in range(3)], classes=())
    assert set(result.metrics.classes) == set(TRACKING_CLASSES)
    assert np.isnan(result.metrics.classes["bus"]["mota"])
    # the walker of the first sample is missed; the one without points and the bicycle in a rack do not count
    assert result.metrics.classes["pedestrian"]["fn"] == 1
    assert np.isnan(result.metrics.classes["bicycle"]["gt"])
    assert result.metrics.overall("mota") == pytest.approx(0.5)
    assert result.metrics.overall("tp") == 3
    assert set(result.to_json()["label_metrics"]) == set(MEASURES)
    table = result.table()
    assert table.rows[-1][0] == "all"
    assert "counted: all 3 frames of 1 scene" in table.notes[-1]


def test_only_the_samples_of_the_run_count(measure):
    with pytest.raises(FormatError, match="hold boxes of 1 samples that are not in this split, the first is s2"):
        measure([box(0), box(1), box(2)], frame_ids=SAMPLES[:2])
    # a run on a part lists the other samples without boxes
    result = measure([box(0), box(1)], frame_ids=SAMPLES[:2])
    assert (car(result)["tp"], car(result)["fp"], car(result)["gt"]) == (2, 0, 2)
    assert result.table().notes[-1].startswith("counted: 2 of the 3 frames of 1 scene")
    with pytest.raises(FormatError, match="lack 1 of 3 samples, the first is s2"):
        measure([box(0)], samples=SAMPLES[:2])
    assert car(measure([box(0)], samples=SAMPLES[:2], missing="empty"))["gt"] == 3


def test_files_that_are_no_tracks(measure):
    for change, message in (
        ({"tracking_id": ""}, "tracking_id of a box of sample s0 must be text or a whole number"),
        ({"tracking_id": None}, "tracking_id of a box of sample s0 must be text or a whole number"),
        ({"tracking_name": "barrier"}, "unknown tracking_name 'barrier'"),
        ({"tracking_score": "high"}, "tracking_score of a box of sample s0 must be a number"),
    ):
        with pytest.raises(FormatError, match=message):
            measure([box(0, **change)])
    detection = {"sample_token": "s0", **{key: box(0)[key] for key in ("translation", "size", "rotation", "velocity")}}
    detection |= {"detection_name": "car", "detection_score": 0.9, "attribute_name": ""}
    with pytest.raises(FormatError, match="has no 'tracking_score': it has 'detection_name', so this is another kind"):
        measure([detection])
    without = box(0)
    del without["tracking_id"]
    with pytest.raises(FormatError, match="a box of sample s0 has no 'tracking_id'"):
        measure([without])
    with pytest.raises(FormatError, match="sample s0 holds track 'a' twice"):
        measure([box(0), box(0)])
    with pytest.raises(FormatError, match="the results hold none of the 3 samples"):
        measure([], samples=("elsewhere",))
    with pytest.raises(ConfigError, match="does not know class 'barrier'"):
        measure([], classes=("barrier",))


def test_labels_that_do_not_tell_objects_apart(measure):
    tables = world_tables()
    for i, record in enumerate(tables["sample_annotation"]):
        tables["instance"].append({"token": f"own{i}", "category_token": "vehicle.car"})
        record["instance_token"] = f"own{i}"
    with pytest.raises(DatasetError, match=r"gives each of its . annotations an instance of its own"):
        measure([box(0)], tables=tables)


def test_command(tmp_path):
    root = write_world(tmp_path / "world")
    names = tmp_path / "all.txt"
    names.write_text("scene-0103\n")
    file = write(tmp_path / "tracking.json", [box(t) for t in range(3)])
    command = ["eval", f"nuscenes:{root}", str(file), "--tracking", "--split", str(names)]
    run = CliRunner().invoke(app, [*command, "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.output)["label_metrics"]["mota"]["car"] == pytest.approx(1)
    run = CliRunner().invoke(app, command)
    assert "AMOTA" in run.output
    run = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "report")])
    assert isinstance(run.exception, ConfigError)


# nuscenes-devkit 1.1.11 (motmetrics 1.1.3, numpy 1.26) on the linked boxes below: the columns are `MEASURES`
DEVKIT = {
    "centerpoint": {
        "bicycle": "0.5194551282 0.7248840823 0.6818181818 0.9166666667 22 0.5 0.1764386833 2 "
        "2 8.3333333333 12 1 7 3 0 0.5 0.6666666667",
        "car": "0.7840275669 0.5338502235 0.8678526048 0.8627760252 787 0.6950444727 0.2755406923 38 "
        "11 217.5 634 87 104 49 2 0.5543478261 0.6413043478",
        "motorcycle": "0.2951388889 1.3607344873 0.5 0.7777777778 22 0.3181818182 0.264326422 0 "
        "0 9.5238095238 9 2 11 2 2 2.25 2.25",
        "pedestrian": "0.769009883 0.5121420354 0.8181818182 0.8311195446 682 0.642228739 0.368043196 30 "
        "9 222.5 527 89 124 31 10 0.3783783784 1.1486486486",
        "truck": "0.4316666667 0.422788608 0.9375 0.4666666667 16 0.4375 0.2949066033 1 "
        "0 44.4444444444 15 8 1 0 0 0.5 0.5",
    },
    "perturbed_gt": {
        "bicycle": "0.2635714286 0.8642975348 0.8636363636 0.4666666667 22 0.3181818182 0.4423840179 3 "
        "1 57.1428571429 15 8 3 4 1 0 0.25",
        "car": "0.5547058025 0.9503710247 0.8030495553 0.8880597015 787 0.6048284625 0.3838456445 35 "
        "2 150 536 60 155 96 80 0.1090909091 0.8090909091",
        "motorcycle": "0 0.9462324689 0.7727272727 0 22 0 0.4328036511 1 0 65.2173913043 15 15 5 2 2 0.5 0.75",
        "pedestrian": "0.7092289076 0.90917839 0.8460410557 0.927480916 682 0.7126099707 0.539810058 26 "
        "1 95 524 38 105 53 44 0.2325581395 0.7674418605",
        "truck": "0.5714285714 0.6852111997 0.9375 0.7857142857 16 0.6875 0.4517378412 1 "
        "0 17.6470588235 14 3 1 1 1 0 0.5",
    },
}


def linked(results, order, reach=3.0):
    """Boxes of a detector that go on with the nearest box of their class in the sample before."""
    out, last, following = {}, [], 0
    for token in order:
        own, now = [], []
        boxes = [found for found in results[token] if found["detection_name"] in TRACKING_CLASSES]
        for found in sorted(boxes, key=lambda found: -found["detection_score"]):
            name, (x, y) = found["detection_name"], found["translation"][:2]
            taken = {track for *_, track in now}
            near = [(np.hypot(x - u, y - v), t) for u, v, other, t in last if other == name and t not in taken]
            distance, track = min(near, default=(np.inf, -1))
            if distance >= reach:
                track, following = following, following + 1
            now.append((x, y, name, track))
            values = {key: found[key] for key in ("sample_token", "translation", "size", "rotation", "velocity")}
            score = found["detection_score"]
            own.append({**values, "tracking_id": str(track), "tracking_name": name, "tracking_score": score})
        out[token], last = own, now
    return {"meta": {}, "results": out}


@pytest.mark.real
@pytest.mark.parametrize("name", DEVKIT)
def test_against_the_devkit(shared, tmp_path, name):
    root = shared / "data" / "nuscenes"
    data = NuscenesDataset(root, split="mini_val")
    results = json.loads((root / "results" / f"{name}.json").read_text())["results"]
    path = tmp_path / "tracking.json"
    path.write_text(json.dumps(linked(results, data.ids)))
    metrics = open_tracking(data, data.ids).read(path).metrics
    for class_name, numbers in DEVKIT[name].items():
        expected = dict(zip(MEASURES, map(float, numbers.split()), strict=True))
        assert metrics.classes[class_name] == pytest.approx(expected, abs=2e-9), class_name
    assert all(np.isnan(metrics.classes[absent]["mota"]) for absent in ("bus", "trailer"))
