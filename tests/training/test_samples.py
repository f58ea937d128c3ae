import numpy as np
import pytest

from lcf3d.errors import ConfigError, FormatError
from lcf3d.training.samples import SampleRecipe, read_image, read_scan, write_samples

pytest.importorskip("embreex")


def test_scans_have_boxes_all_around_and_a_longer_set_begins_with_the_shorter(tmp_path):
    done = []
    (path,) = write_samples(SampleRecipe("lidar", "sparse16", 1, 3), tmp_path, progress=done.append)
    assert sum(done) == 1
    sample = read_scan(path)
    assert sample.points.dtype == np.float32
    assert len(sample.boxes) == len(sample.names) == len(sample.points_on)
    assert (sample.boxes[:, 0] < 0).any(), "behind the car too"
    before = path.read_bytes()
    assert write_samples(SampleRecipe("lidar", "sparse16", 1, 3), tmp_path)[0].read_bytes() == before
    path.unlink()
    assert write_samples(SampleRecipe("lidar", "sparse16", 1, 3), tmp_path)[0].read_bytes() == before


def test_images_have_boxes_and_owners(tmp_path):
    (path,) = write_samples(SampleRecipe("camera", "kitti64", 1, 4, scale=0.25), tmp_path)
    sample = read_image(path)
    height, width, _ = sample.image.shape
    assert sample.owner.shape == (height, width) == (94, 310)
    for k, (x1, y1, x2, y2) in enumerate(sample.visible.astype(int)):
        rows, columns = np.nonzero(sample.owner == k + 1)
        assert (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1) == (x1, y1, x2, y2)
    assert (sample.boxes[:, :2] >= 0).all()


def test_another_recipe_a_torn_file_and_impossible_numbers(tmp_path):
    recipe = SampleRecipe("lidar", "sparse16", 1, 3)
    (path,) = write_samples(recipe, tmp_path)
    with pytest.raises(ConfigError, match="samples of another recipe"):
        write_samples(SampleRecipe("lidar", "sparse16", 1, 4), tmp_path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(FormatError, match="no training sample"):
        read_scan(path)
    with pytest.raises(ConfigError, match="frames must be 1 or more"):
        SampleRecipe("lidar", "kitti64", 0, 1)
