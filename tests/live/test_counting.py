import pytest
from hypothesis import given
from hypothesis import strategies as st

from lcf3d.live.counting import LATELY, LONGEST_STEP, Stream, StreamClock, Tally


def test_a_stream_clock_goes_with_the_quickest_source_whatever_their_stamps():
    clock = StreamClock()
    for i in range(11):
        clock.saw("lidar", 100 + 0.1 * i)
        clock.saw("camera", 5000 + 0.1 * i)
    assert clock.now == pytest.approx(1.0)
    assert clock.silent("lidar") == pytest.approx(0.0)
    for i in range(11, 31):
        clock.saw("camera", 5000 + 0.1 * i)
    assert clock.silent("lidar") == pytest.approx(2.0)
    assert clock.silent("never seen") == 0.0


def test_a_clock_that_is_set_and_a_pause_move_it_by_one_step_only():
    clock = StreamClock()
    clock.saw("lidar", 0.0)
    clock.saw("lidar", 3600.0)
    assert clock.now == LONGEST_STEP
    clock.saw("lidar", 5.0)
    clock.saw("lidar", 5.5)
    assert clock.now == pytest.approx(LONGEST_STEP + 0.5)


@given(st.permutations(range(8)))
def test_the_order_of_neighbours_does_not_matter(order):
    clock = StreamClock()
    for i in order:
        clock.saw("camera", 0.1 * i)
    assert clock.now == pytest.approx(0.1 * (7 - order[0]))


def test_counts_are_forgotten_and_totals_are_not():
    clock = StreamClock()
    tally = Tally(clock)
    for i in range(100):
        clock.saw("lidar", float(i))
        if i < 40:
            tally.add("lost")
    # the clock stands at 99; the last was lost at 39
    assert tally.total["lost"] == 40
    assert tally.lately() == {}
    tally.add("lost")
    assert (tally.lately()["lost"], tally.total["lost"]) == (1, 41)
    assert LATELY < 60


def test_after_time_went_back_delays_are_of_the_new_time():
    stream = Stream()
    stream.stamps.extend([100.0, 100.1])
    stream.arrivals.extend([0.0, 0.1])
    stream.begin_anew()
    stream.stamps.append(3.0)
    stream.arrivals.append(3.5)
    assert stream.delay == pytest.approx(0.5)
