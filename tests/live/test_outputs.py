import threading
from types import SimpleNamespace

from lcf3d.live.outputs import Output, Outputs
from tests.live.streams import fuser, run, stream


def test_an_output_that_is_slow_leaves_out_what_is_old_and_says_so():
    begun, release, shown = threading.Event(), threading.Event(), []

    def show(task):
        begun.set()
        release.wait(20)
        shown.append(task)

    output = Output("pictures", show, realtime=True)
    output(0)
    begun.wait(20)
    for i in range(1, 5):
        output(i)
    release.set()
    output.close()
    assert shown == [0, 4]
    assert output.report() == "pictures: 2 frames, 3 left out for want of time"


def test_an_output_that_fails_is_told_and_stops_nothing():
    def show(task):
        raise OSError("disk full")

    output = Output("pictures", show, realtime=True)
    output(0)
    output.close()
    assert output.report() == "pictures: 0 frames; failed: OSError: disk full"


def test_a_line_of_health_a_second(tmp_path):
    target = fuser()
    outputs = Outputs(target, False, health=tmp_path / "deep" / "health.jsonl")
    for result in run(target, stream(25)):
        outputs([result])
    outputs.close()
    lines = (tmp_path / "deep" / "health.jsonl").read_text().splitlines()
    assert len(lines) == 2
    # times that begin anew are told at once
    outputs = Outputs(target, False, health=tmp_path / "health.jsonl")
    outputs([SimpleNamespace(time=50.0)])
    outputs([SimpleNamespace(time=3.0)])
    outputs.close()
    assert len((tmp_path / "health.jsonl").read_text().splitlines()) == 2
