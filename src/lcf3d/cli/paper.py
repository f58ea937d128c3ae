"""``lcf3d paper``: the paper's tables beside what is measured on this machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lcf3d.errors import ConfigError

if TYPE_CHECKING:
    from lcf3d.paper.tables import Row, Table


def paper(
    table: Annotated[
        str, typer.Argument(help="list, splits, all, or one of the list, for example table-1; with --rehearse all")
    ] = "",
    out: Annotated[Path, typer.Option(help="folder for the tables and the runs behind them")] = Path("tables"),
    kitti: Annotated[Path | None, typer.Option(help="folder of KITTI's object benchmark")] = None,
    nuscenes: Annotated[Path | None, typer.Option(help="folder of nuScenes")] = None,
    row: Annotated[
        list[str] | None,
        typer.Option(help="only rows of which this is the name or its beginning; repeatable"),
    ] = None,
    use: Annotated[
        list[str] | None,
        typer.Option(help="what stands for a network: NAME=FILE of weights, or NAME=kind:ARGUMENT; repeatable"),
    ] = None,
    results: Annotated[
        list[str] | None, typer.Option(help="result files of any row's system, NAME=DIR; one table; repeatable")
    ] = None,
    rehearse: Annotated[
        bool,
        typer.Option(
            "--rehearse", help="weights filled by rule, and simulated frames where no data is named: do all steps run?"
        ),
    ] = False,
    device: Annotated[str, typer.Option(help="of the networks: cpu or cuda")] = "cpu",
    dry: Annotated[bool, typer.Option("--dry", help="run nothing: the numbers, and what would be needed")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="begin runs anew that had other inputs")] = False,
    json_: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Print a table of the paper beside what is measured here: paper, measured, difference.

    What is missing is run with the paper's settings, and an interrupted run goes on. Rows that cannot be measured say
    what they need.

    lcf3d paper list                                          the tables, what they need, about how long they take

    lcf3d paper table-1 --kitti KITTI --out tables            published weights are downloaded at first use

    lcf3d paper table-2 --kitti KITTI --results LoGoNet=DIR   fills the row of a quoted system

    lcf3d paper splits --out KITTI/ImageSets                  train.txt and val.txt of the usual split

    lcf3d paper --rehearse --out rehearsal                    all of it on simulated frames, without any download
    """
    from lcf3d.files import write_text
    from lcf3d.paper.networks import parse_uses
    from lcf3d.paper.tables import find_rows, find_table, paper_tables

    table = table or ("all" if rehearse else "list")
    if table == "list":
        return _print_list(json_)
    if table == "splits":
        from lcf3d.paper.splits import KITTI_TRAIN, KITTI_VAL

        for name, ids in (("train", KITTI_TRAIN), ("val", KITTI_VAL)):
            write_text(out / f"{name}.txt", "".join(f"{frame_id}\n" for frame_id in ids))
        return typer.echo(f"wrote {out / 'train.txt'} ({len(KITTI_TRAIN):,} frames) and val.txt ({len(KITTI_VAL):,})")
    chosen = find_rows(list(paper_tables().values()) if table == "all" else [find_table(table)], row or [])
    if len(chosen) > 1 and results:
        raise ConfigError("--results is for one table; name it")
    uses = parse_uses(tuple(use or ()))
    roots = {k: v.expanduser() for k, v in (("kitti", kitti), ("nuscenes", nuscenes)) if v is not None}
    for kind, folder in roots.items():
        if not folder.is_dir():
            raise ConfigError(f"--{kind} {folder}: there is no such folder")
    if rehearse:
        from lcf3d.paper.cost import networks_of
        from lcf3d.paper.rehearsal import filled_weights, simulated_data

        names = {name for one, rows in chosen for r in rows for name in networks_of(one, r)}
        uses = {**filled_weights(sorted(names - set(uses)), out / "rehearsal"), **uses}
        roots = {
            **simulated_data({kind for one, _ in chosen for kind in one.data} - set(roots), out / "rehearsal"),
            **roots,
        }
    failed = _measure(chosen, results, roots, uses, out, device, dry, overwrite, json_)
    if failed:
        typer.echo(f"error: {len(failed)} rows did not run, first {failed[0]}; the notes say why", err=True)
        # else a row may only wait for a download
        raise typer.Exit(1 if rehearse else 0)


def _measure(
    chosen: list[tuple[Table, tuple[Row, ...]]],
    results: list[str] | None,
    roots: Mapping[str, Path],
    uses: Mapping[str, str],
    out: Path,
    device: str,
    dry: bool,
    overwrite: bool,
    json_: bool,
) -> list[str]:
    """Measure, print and write tables one after the other; the rows that failed, not those that lack something."""
    from rich.console import Console
    from rich.progress import Progress

    from lcf3d.cli.console import print_json, print_table
    from lcf3d.files import write_json, write_text
    from lcf3d.paper.report import markdown, table_data, to_json
    from lcf3d.paper.rows import FAILED, given_results, measured_rows, needed_rows
    from lcf3d.paper.workplace import Workplace

    contents = []
    with Progress(console=Console(stderr=True), disable=json_ or dry, transient=True) as progress:

        def begin(name: str, frames: int) -> Callable[[], None]:
            bar = progress.add_task(name, total=frames)
            return lambda: progress.advance(bar)

        for one, rows in chosen:
            place = Workplace(out, roots, uses, given_results(one, results or ()), device, overwrite, begin)
            measured = needed_rows(one, rows) if dry else measured_rows(one, rows, place)
            contents.append(to_json(one, rows, measured))
            data = table_data(one, rows, measured)
            if not dry:
                write_json(out / f"{one.name}.json", contents[-1])
                write_text(out / f"{one.name}.md", markdown(data))
            if not json_:
                progress.stop()
                print_table(data)
    if json_:
        print_json(contents if len(contents) > 1 else contents[0])
    rows_of = [(content["table"], row) for content in contents for row in content["rows"]]
    return [f"{t}: {row['name']}" for t, row in rows_of if any(n.startswith(FAILED) for n in row["notes"])]


def _print_list(json_: bool) -> None:
    """The tables, what they are measured on and about how long that takes."""
    from dataclasses import asdict

    from lcf3d.cli.console import print_json
    from lcf3d.paper.estimates import DATA, about
    from lcf3d.paper.tables import paper_tables

    tables = paper_tables()
    if json_:
        print_json([asdict(one) for one in tables.values()])
        return
    for one in tables.values():
        numbers = sum(value is not None for r in one.rows for value in r.values)
        typer.echo(f"{one.name}   {one.title}")
        typer.echo(f"    {len(one.rows)} rows, {numbers} numbers; {one.place}")
        needs = " and ".join(f"--{kind}" for kind in one.data) or "no data"
        typer.echo(f"    measured with {needs}; {about(one, one.rows) or 'minutes'}")
    for kind, text in DATA.items():
        typer.echo(f"--{kind}: {text}")
