"""What works without torch, and what is said where it does not."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import sys
sys.modules["torch"] = None
import numpy as np
from lcf3d.detectors.lidar import OnnxLidarDetector, accumulate_sweeps
from lcf3d.detectors.lidar import kinds
from lcf3d.errors import MissingExtraError
print(accumulate_sweeps(np.ones((2, 4)), []).shape)
for use in (lambda: kinds.pointpillars("weights.pth"), lambda: __import__("lcf3d.detectors.lidar.second")):
    try:
        use()
    except MissingExtraError as error:
        print(error)
"""


def test_the_sentence_says_what_to_install():
    result = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=True)
    shape, reading, network = result.stdout.splitlines()
    assert shape == "(2, 5)"
    assert reading == network
    assert network == "a network in torch needs torch; install it with: pip install 'lcf3d[train]'"
