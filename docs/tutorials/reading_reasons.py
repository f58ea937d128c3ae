# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Reading reasons
#
# Why is this box here, and where did that one go? Every input and every output of a fusion has an answer.

# %%
from lcf3d import FusionConfig, LateCascadeFusion, demo_frames, draw, load_detector, load_localizer

frame = demo_frames(1, beam_step=4)[0]
classes = ("Car", "Pedestrian", "Cyclist")
lidar = load_detector("shipped:kitti", "lidar", classes)(frame.points)
camera = load_detector("shipped:kitti", "camera", classes)([frame.images["left"]])[0]

fusion = LateCascadeFusion(FusionConfig.preset("kitti"), load_localizer("network"))
fused = fusion(frame, lidar, {"left": camera})
print(len(lidar), "LiDAR boxes and", len(camera), "camera boxes became", len(fused.detections))

# %%
draw(frame, fused, min_score=0.2)

# %% [markdown]
# ## Why is this box here?

# %%
order = fused.detections.scores.argsort()[::-1]
for i in order[:4]:
    print(f"{i}: {fused.explain(int(i))}")

# %% [markdown]
# One box that the LiDAR network missed and the camera led to, if there is one, and one that nobody confirms:

# %%
for outcome in ("recovered", "kept"):
    for i in order:
        if f", {outcome}" in fused.explain(int(i)):
            print(f"{i}: {fused.explain(int(i))}")
            break

# %% [markdown]
# ## What became of that detection?
#
# Each LiDAR and camera detection has a row, whether something came of it or not.

# %%
from collections import Counter

print("LiDAR: ", Counter(str(fused.lidar.row(i)["reason"]) for i in range(len(lidar))).most_common())
print("camera:", Counter(str(fused.camera.row(i)["reason"]) for i in range(len(camera))).most_common())

# %%
print(fused.explain_lidar(0))
print(fused.explain_camera(0))
fused.lidar.row(0)

# %% [markdown]
# ## Change a setting, and see what it does
#
# The paper deletes what no camera confirms. The default doubts it: the score goes down, the box stays.

# %%
paper = LateCascadeFusion(FusionConfig.preset("kitti").updated(unmatched="drop"), load_localizer("network"))
print("default:", len(fused.detections), "boxes;  deleting:", len(paper(frame, lidar, {"left": camera}).detections))

# %% [markdown]
# All reasons are listed in [Reading the reasons](../../reasons/). On disk, `provenance/ID.json` of a run holds the same, and
# `lcf3d view RUN` draws it.
