"""What ``lcf3d bench`` measures: medians on this machine, beside a reference in the same run."""
