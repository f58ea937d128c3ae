"""``lcf3d eval``: results against ground truth by a dataset's official metric, as tables, JSON and an HTML report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from lcf3d.errors import ConfigError


def eval(
    dataset: Annotated[str, typer.Argument(help="kitti:ROOT (holds training/label_2) or nuscenes:ROOT")],
    results: Annotated[
        list[Path], typer.Argument(help="KITTI: folder of result files, or a folder of 'lcf3d run'; nuScenes: a .json")
    ],
    split: Annotated[
        str | None, typer.Option(help="KITTI: a list in ROOT/ImageSets; nuScenes: a split or a file of scene names")
    ] = None,
    class_: Annotated[list[str] | None, typer.Option("--class", help="only this class; repeatable (KITTI)")] = None,
    iou: Annotated[
        list[str] | None, typer.Option(help="IoU threshold, Car=0.5 or Car:3d=0.5 for one measure; repeatable (KITTI)")
    ] = None,
    missing: Annotated[str, typer.Option(help="frames without a result file: error, or empty (KITTI)")] = "error",
    compare: Annotated[bool, typer.Option("--compare", help="two results side by side (KITTI)")] = False,
    samples: Annotated[int, typer.Option(min=1, help="bootstrap resamples of --compare")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="seed of the resampling")] = 0,
    out: Annotated[Path | None, typer.Option(help="folder for the metrics and, for KITTI, report.html")] = None,
    worst: Annotated[int, typer.Option(min=0, help="frames with most errors in the report (KITTI)")] = 8,
    version: Annotated[str | None, typer.Option(help="folder of tables (nuScenes)")] = None,
    front: Annotated[bool, typer.Option("--front", help="only the front camera's view (nuScenes)")] = False,
    nds_hat: Annotated[bool, typer.Option("--nds-hat", help="NDS^: no velocity, no attributes")] = False,
    json_: Annotated[bool, typer.Option("--json", help="print the metrics as JSON")] = False,
) -> None:
    """Measure results against ground truth.

    Example: lcf3d eval kitti:KITTI fused --split val --out report

    Example: lcf3d eval kitti:KITTI --compare results/pointpillars fused

    Example: lcf3d eval nuscenes:NUSCENES results.json
    """
    from lcf3d.datasets.opening import parse_dataset

    kind, root = parse_dataset(dataset)
    _check_count(results, compare)
    if kind == "nuscenes":
        from lcf3d.cli.eval_nuscenes import eval_nuscenes

        refused = {"--class": class_, "--iou": iou, "--missing": missing != "error", "--compare": compare}
        _refuse("nuScenes", refused)
        eval_nuscenes(
            root, results[0], version=version, split=split, front=front, nds_hat=nds_hat, as_json=json_, out=out
        )
        return
    from lcf3d.cli.eval_kitti import KittiQuestion, eval_kitti

    _refuse("KITTI", {"--version": version, "--front": front})
    if nds_hat:
        _refuse("--nds-hat", {"--compare": compare, "--iou": iou})
    question = KittiQuestion(root, tuple(results), split, tuple(class_ or ()), tuple(iou or ()), missing)
    eval_kitti(question, compare, samples, seed, out, worst, nds_hat, json_)


def _check_count(results: Sequence[Path], compare: bool) -> None:
    if compare and len(results) != 2:
        raise ConfigError(f"--compare needs two results, got {len(results)}")
    if not compare and len(results) > 1:
        raise ConfigError(f"got {len(results)} results; give one, or two with --compare")


def _refuse(kind: str, options: Mapping[str, object]) -> None:
    for name, given in options.items():
        if given:
            raise ConfigError(f"{name} does not go with {kind}; leave it out")
