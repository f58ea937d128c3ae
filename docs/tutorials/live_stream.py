# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A live stream
#
# On a vehicle, boxes and images come one by one, late, and not always. `Fuser` takes messages with their own times and
# gives fused boxes as soon as a moment is complete. Here a drive is played to it: the LiDAR's boxes first, the camera's
# 30 ms later, and after a second the camera dies.

# %%
from lcf3d import (
    CameraBoxes,
    Fuser,
    FusionConfig,
    LateCascadeFusion,
    LidarBoxes,
    LiveSettings,
    SyncSettings,
    demo_frames,
    load_detector,
)

frames = demo_frames(20, beam_step=4)
classes = ("Car", "Pedestrian", "Cyclist")
lidar_detector = load_detector("shipped:kitti", "lidar", classes)
camera_detector = load_detector("shipped:kitti", "camera", classes)

messages = []
for i, frame in enumerate(frames):
    messages.append(LidarBoxes(frame.timestamp, lidar_detector(frame.points)))
    if i < 10:
        messages.append(CameraBoxes(frame.timestamp + 0.03, "left", camera_detector([frame.images["left"]])[0]))
print(len(messages), "messages of", len(frames), "moments")

# %% [markdown]
# ## Push

# %%
fusion = LateCascadeFusion(FusionConfig.preset("kitti").updated(recovery=False))
fuser = Fuser(fusion, list(frames[0].cameras), settings=LiveSettings(SyncSettings(scans=False, tolerance=0.05)))
fuser.warm_up()

results = [result for message in messages for result in fuser.push(message)] + list(fuser.flush())
for result in results[::3]:
    sure = int((result.fused.detections.scores > 0.5).sum())
    print(f"{result.time:4.1f} s  {sure:2} boxes above 0.5  {result.latency_ms['added']:5.1f} ms  {result.fused.notes}")

# %% [markdown]
# Without the camera the fusion does not stop: the boxes stay, what only the camera could say is missing, and `notes` says
# so. Nothing was deleted for want of a witness who was not there.
#
# ## A curve of it

# %%
import matplotlib.pyplot as plt
import numpy as np

figure, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
times = np.array([result.time for result in results])
axes.plot(times, [(result.fused.detections.scores > 0.5).sum() for result in results], "o-", label="fused")
alone = [(message.detections.scores > 0.5).sum() for message in messages if isinstance(message, LidarBoxes)]
axes.plot([frame.timestamp for frame in frames], alone, "s--", label="LiDAR network, doubles included")
axes.axvline(0.95, color="0.5", linewidth=1)
axes.annotate("the camera dies", (0.95, axes.get_ylim()[1] * 0.9), xytext=(6, 0), textcoords="offset points")
axes.set_xlabel("seconds")
axes.set_ylabel("boxes above 0.5")
axes.legend(loc="lower left", fontsize=8)
plt.show()

# %% [markdown]
# ## Health

# %%
for status in fuser.diagnostics():
    print(f"{status['name']:22}", status["message"])

# %% [markdown]
# The same on a data set: `lcf3d live kitti:KITTI --lidar results:DIR --camera results:DIR`. ROS 2, moving cameras, clocks
# and deadlines are in [Live](../../live/).
