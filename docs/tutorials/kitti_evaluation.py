# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # KITTI evaluation
#
# KITTI's own numbers, on anything in KITTI's layout: AP in the image, from above and in 3D, by difficulty. With the real
# data set, begin at "Measure". Here ten frames of the simulated drive in the wheel stand for it.

# %%
from pathlib import Path
from tempfile import mkdtemp

import lcf3d

work = Path(mkdtemp())
lcf3d.write_kitti(lcf3d.demo_frames(10), work / "KITTI", camera="left")
dataset = lcf3d.open_dataset(f"kitti:{work / 'KITTI'}", split="val")
sorted(str(path.relative_to(work)) for path in (work / "KITTI").rglob("*") if "000003" in path.name)

# %% [markdown]
# ## Fuse
#
# In the place of `shipped:kitti` put `results:DIR` with KITTI result files of your detectors.

# %%
counts = lcf3d.run(
    f"kitti:{work / 'KITTI'}", lidar="shipped:kitti", camera="shipped:kitti", out=work / "fused", split="val"
)
counts["outputs"]

# %% [markdown]
# ## Measure

# %%
results = lcf3d.evaluate(f"kitti:{work / 'KITTI'}", work / "fused", split="val")
car = results.to_json()["Car"]
for measure in ("bbox", "bev", "3d"):
    values = [car[measure][level]["AP_R40"] for level in ("easy", "moderate", "hard")]
    print(f"Car {measure:5}" + "".join(f"{value:8.2f}" for value in values))

# %% [markdown]
# `tables()` has what `lcf3d eval` prints:

# %%
table = results.tables()[0]
print(table.title)
for row in table.rows[:4]:
    print("  ".join(f"{cell!s:>8}" for cell in row))

# %% [markdown]
# ## Is it better than the LiDAR alone?
#
# The same protocol on the detector's own boxes. A run with `unmatched=keep`, without recovery and without semantic fusion
# changes nothing but suppressing doubles: that is the LiDAR branch in the same files.

# %%
lcf3d.run(
    f"kitti:{work / 'KITTI'}",
    lidar="shipped:kitti",
    camera="shipped:kitti",
    out=work / "alone",
    split="val",
    changes=("unmatched=keep", "ensemble=none", "recovery=false"),
)
alone = lcf3d.evaluate(f"kitti:{work / 'KITTI'}", work / "alone", split="val").to_json()
fused = results.to_json()
for name in dataset.class_names:
    pair = [metrics[name]["3d"]["moderate"]["AP_R40"] for metrics in (alone, fused)]
    print(f"{name:12} 3D moderate: {pair[0]:6.2f} -> {pair[1]:6.2f}")

# %% [markdown]
# Ten frames of one street prove nothing: with fewer than 41 objects of a class not even perfect results reach 100. On real
# data ask for intervals: `lcf3d eval kitti:KITTI --compare alone fused` draws frames again a thousand times. What KITTI's
# protocol does, with its quirks, is in [Evaluation](../../evaluation/).
