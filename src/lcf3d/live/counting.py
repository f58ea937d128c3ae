"""What is counted of a stream: how long it has gone on by its own stamps, what happened lately and in all, rates."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

# seconds of the stream after which what went wrong raises no level any more
LATELY = 30.0
# a step between two stamps counts for no more than this: it is a pause, or a clock that was set (seconds)
LONGEST_STEP = 1.0
# messages that rates and delays are measured over
RECENT = 50

Key = TypeVar("Key", bound=Hashable)


class StreamClock:
    """Seconds that a stream has gone on: by the stamps of its sources, each against its own last one.

    So clocks that differ do not matter, and one that is set moves it by no more than `LONGEST_STEP`.

    Attributes:
        now: seconds since the first message.
    """

    def __init__(self) -> None:
        self.now = 0.0
        # newest stamp of each source, the moment it stands for, and when the source was seen last
        self._sources: dict[str, tuple[float, float, float]] = {}

    def saw(self, source: str, stamp: float) -> None:
        """A message with a finite time stamp came."""
        newest, moment, _ = self._sources.get(source, (stamp, self.now, self.now))
        step = stamp - newest
        if step > 0 or step < -LONGEST_STEP:
            newest, moment = stamp, moment + min(max(step, 0.0), LONGEST_STEP)
        self.now = max(self.now, moment)
        self._sources[source] = (newest, moment, self.now)

    def silent(self, source: str) -> float:
        """Seconds since a source was seen, 0 for one that never was."""
        known = self._sources.get(source)
        return 0.0 if known is None else self.now - known[2]


class Tally(Generic[Key]):
    """Counts of what happened, in all and in the latest `LATELY` seconds of a stream.

    Args:
        clock: of the stream.

    Attributes:
        total: counts since the beginning.
    """

    def __init__(self, clock: StreamClock | None = None) -> None:
        self.total: Counter[Key] = Counter()
        self._clock = clock or StreamClock()
        # a few a second at most, however much happens
        self._bins: deque[tuple[int, Counter[Key]]] = deque()

    def add(self, key: Key) -> None:
        """It happened once more."""
        self.total[key] += 1
        second = int(self._clock.now)
        if not self._bins or self._bins[-1][0] != second:
            self._forget()
            self._bins.append((second, Counter()))
        self._bins[-1][1][key] += 1

    def lately(self) -> Counter[Key]:
        """Counts of the latest `LATELY` seconds."""
        self._forget()
        return sum((counts for _, counts in self._bins), Counter())

    def _forget(self) -> None:
        while self._bins and self._bins[0][0] < self._clock.now - LATELY:
            self._bins.popleft()


@dataclass
class Stream:
    """What is known of one stream of messages: times by the sensor, times of arrival, equal messages in a row."""

    stamps: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    arrivals: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT))
    count: int = 0
    backwards: int = 0
    equal: int = 0
    content: int | None = None

    @property
    def rate(self) -> float:
        """Messages a second by the sensor's clock, NaN with fewer than three."""
        steps = np.diff(np.sort(np.array(self.stamps)))
        middle = float(np.median(steps)) if len(steps) > 1 else 0.0
        return 1 / middle if middle > 0 else float("nan")

    @property
    def delay(self) -> float:
        """Median seconds from a message's time to its arrival, by clocks that may differ; infinite without any."""
        return float(np.median(np.subtract(self.arrivals, self.stamps))) if self.stamps else float("inf")

    @property
    def delay_spread(self) -> float:
        """Seconds by which the slowest twentieth is later than the median."""
        return float(np.percentile(np.subtract(self.arrivals, self.stamps), 95)) - self.delay if self.stamps else 0.0

    def begin_anew(self) -> None:
        """Time went back: what stamps and arrivals told is of another time."""
        self.stamps.clear()
        self.arrivals.clear()
