"""``lcf3d serve``: the report over all frames of a run, in the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def serve(
    run: Annotated[Path, typer.Argument(help="folder of 'lcf3d run'")],
    dataset: Annotated[str | None, typer.Option(help="kind:ROOT, where the run's dataset has moved")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="of 127.0.0.1; 0 for any free one")] = 8000,
) -> None:
    """Look at every frame of a run: the report, with pictures and scans read when they are asked for.

    Example: lcf3d serve fused
    """
    from lcf3d.cli.console import console
    from lcf3d.cli.eval import report_origin
    from lcf3d.cli.export import dataset_of_run
    from lcf3d.evaluation.opening import open_evaluation
    from lcf3d.evaluation.protocol import EvaluationOptions
    from lcf3d.evaluation.server import HOST, listen, report_app
    from lcf3d.evaluation.server import serve as serve_app
    from lcf3d.remote.places import local
    from lcf3d.run.conversion import as_files
    from lcf3d.run.table_folder import open_run_folder

    # before anything is read
    listening = listen(port)
    folder = local(run)
    data, name = dataset_of_run(folder, dataset)
    done = set(open_run_folder(folder).frame_ids())
    evaluation = open_evaluation(data, [frame_id for frame_id in data.ids if frame_id in done])
    results = evaluation.read(as_files(folder, data), folder.resolve().name)
    app = report_app(results, data, report_origin(data, name, [folder], EvaluationOptions()))
    console().print(f"http://{HOST}:{listening.getsockname()[1]}/ (stop with Ctrl-C)", soft_wrap=True)
    serve_app(app, listening)
