from pathlib import Path

from lcf3d.fusion.config import FusionConfig
from lcf3d.run.settings import build_config
from lcf3d.structures import ARGOVERSE_CLASSES, KITTI_CLASSES, NUSCENES_CLASSES

OWN = ("tractor", "cow")


def test_presets_of_no_dataset_take_the_classes_of_the_dataset(tmp_path: Path) -> None:
    for name in ("default", "paper"):
        assert build_config(name, class_names=OWN).class_names == OWN
        assert build_config(name, class_names=OWN, stereo=True).class_names == OWN
        assert build_config(name).class_names == KITTI_CLASSES
    assert build_config("default", ["class_names=[cow]"], class_names=OWN).class_names == ("cow",)


def test_presets_of_a_dataset_and_files_name_their_own(tmp_path: Path) -> None:
    assert build_config("nuscenes", class_names=OWN).class_names == NUSCENES_CLASSES
    assert build_config("argoverse2", class_names=OWN).class_names == ARGOVERSE_CLASSES
    FusionConfig(class_names=("Tram",)).dump(tmp_path / "config.yaml")
    assert build_config(tmp_path / "config.yaml", class_names=OWN).class_names == ("Tram",)
