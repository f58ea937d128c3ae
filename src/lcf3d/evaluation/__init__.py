"""Official metrics on plain arrays, curves and reports."""
