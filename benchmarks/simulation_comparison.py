"""Compare a simulated folder with a real one, both in KITTI's layout: statistics of scans and labels, and a figure.

``python benchmarks/simulation_comparison.py KITTI SIMULATED --figure comparison.png``
"""

import argparse
import json
from pathlib import Path

from lcf3d.simulation.comparison import compare

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("real", type=Path)
    parser.add_argument("simulated", type=Path)
    parser.add_argument("--figure", type=Path, help="where to draw both")
    arguments = parser.parse_args()
    print(json.dumps(compare(arguments.real, arguments.simulated, figure=arguments.figure), indent=2))
