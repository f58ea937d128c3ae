"""Damaged files never end in anything but one of lcf3d's errors, each one short sentence.

The same damages every time. ``LCF3D_FUZZ=10000`` tries so many a reader, ``LCF3D_FUZZ_SEED`` other ones: see
docs/reliability.md.
"""

from __future__ import annotations

import os
import random
import traceback
import warnings
from pathlib import Path

import pytest

from lcf3d.errors import Lcf3dError
from tests.fuzz.readers import READERS

COUNT = int(os.environ.get("LCF3D_FUZZ", "200"))
SEED = int(os.environ.get("LCF3D_FUZZ_SEED", "20"))
LONGEST = 700


@pytest.mark.parametrize("name", READERS)
def test_damaged_files(name: str, tmp_path: Path) -> None:
    reader = READERS[name]
    for package in reader.needs:
        pytest.importorskip(package)
    path = tmp_path / reader.file
    reader.make(path)
    good = path.read_bytes()
    reader.read(path)
    random_ = random.Random(f"{SEED} {name}")
    faults: dict[str, bytes] = {}
    refused = 0
    for _ in range(max(COUNT // reader.cost, 1)):
        damaged = reader.mutate(good, random_)
        path.write_bytes(damaged)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                reader.read(path)
        except Lcf3dError as error:
            refused += 1
            text = str(error).replace(str(tmp_path), "")
            if len(text) > LONGEST or "\n" in text or "\x1b" in text:
                faults.setdefault(f"message of {len(text)} characters: {text[:80]!r}", damaged)
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            own = [f for f in frames if "/lcf3d/" in f.filename] or frames
            where = f"{Path(own[-1].filename).name}:{own[-1].lineno}"
            faults.setdefault(f"{type(error).__name__} at {where}: {str(error)[:100]}", damaged)
    assert not faults, "\n".join(f"{fault}\n    {damaged[:200]!r}" for fault, damaged in faults.items())
    assert refused > 0, "the damages do not reach what is read"
