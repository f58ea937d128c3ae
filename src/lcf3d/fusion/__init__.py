"""The late-cascade fusion of the paper, one module a section."""
