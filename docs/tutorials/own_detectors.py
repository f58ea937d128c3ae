# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Own detectors on a folder
#
# You have images, scans and a calibration in a folder, and two detectors of your own. This notebook goes from there to
# fused boxes, a picture and numbers. Every cell was run to make this page. The data is half a second of the simulated
# drive that comes with lcf3d, so that nothing is downloaded.
#
# ## The folder

# %%
from pathlib import Path
from tempfile import mkdtemp

from lcf3d import demo_frames, open_dataset, write_folder

work = Path(mkdtemp())
write_folder(demo_frames(5, beam_step=4), work / "drive", image_format="jpg")
print((work / "drive" / "sensors.yaml").read_text())

# %% [markdown]
# With data of your own, `lcf3d init drive` writes a first `sensors.yaml`, and you put in your calibration: see
# [My own data](../../my-own-data/). Opened as a data set, a frame gives points, images and cameras, and the check says
# whether they agree.

# %%
dataset = open_dataset(f"folder:{work / 'drive'}")
print(len(dataset), "frames;", dataset[0].points.shape[0], "points;", [camera.name for camera in dataset[0].cameras])
print(dataset.check() or "all rules hold")

# %% [markdown]
# ## The detectors
#
# A LiDAR detector takes points and gives `Detections3D`, a camera detector takes images and gives one `Detections2D`
# each. Yours goes here. These two are the small networks in the wheel.

# %%
from lcf3d import load_detector

classes = dataset.class_names
my_lidar_detector = load_detector("shipped:kitti", "lidar", classes)
my_camera_detector = load_detector("shipped:kitti", "camera", classes)

boxes = my_lidar_detector(dataset[0].points)
print(len(boxes), "boxes before fusion; the first:", boxes.boxes[0].round(2), classes[boxes.labels[0]])

# %% [markdown]
# Their results as files, one a frame:

# %%
from lcf3d import write_detections_2d, write_detections_3d

for frame in dataset:
    write_detections_3d(work / "lidar_results" / f"{frame.id}.json", my_lidar_detector(frame.points))
    found = {name: my_camera_detector([image])[0] for name, image in frame.images.items()}
    write_detections_2d(work / "camera_results" / f"{frame.id}.json", found)

# %% [markdown]
# ## Fuse, look, measure
#
# This is `lcf3d run folder:drive --lidar results:lidar_results --camera results:camera_results --out fused`.

# %%
import lcf3d

counts = lcf3d.run(
    f"folder:{work / 'drive'}",
    lidar=f"results:{work / 'lidar_results'}",
    camera=f"results:{work / 'camera_results'}",
    out=work / "fused",
)
counts["outputs"]

# %%
fused = lcf3d.read_run(work / "fused")
lcf3d.draw(dataset[0], fused[dataset[0].id], min_score=0.2)

# %% [markdown]
# Green boxes were matched with a camera detection (yellow), orange ones recovered from it, pink ones were doubted because
# no camera detection confirms them. Thin white is the ground truth. What became of each box is in
# [Reading reasons](../reading_reasons/).
#
# Average precision by centre distance, LiDAR alone and fused:

# %%
for name in ("lidar_results", "fused"):
    metrics = lcf3d.evaluate(f"folder:{work / 'drive'}", work / name).to_json()
    print(f"{name:14} mean AP {100 * metrics['mean_ap']:.1f}")

# %% [markdown]
# Five frames are an example, not a measurement. Next: [KITTI evaluation](../kitti_evaluation/).
