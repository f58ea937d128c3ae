"""Simulate on all cores of a machine and train every small network beside it, within a given number of minutes.

    python benchmarks/train_all.py --out trained --minutes 9.5

Simulating goes on nearly all the time; the trainings (camera, LiDAR, the localizers of KITTI's and nuScenes' classes,
each in a process of its own, on the GPU if there is one) begin as soon as there are some samples and take in new ones
as they come. OUT receives ``camera.pt``, ``lidar.pt``, ``localizer_kitti.pt``, ``localizer_nuscenes.pt`` (averaged
weights, written every minute, for ``lcf3d train ... --init``), the finished ``camera.onnx`` and ``lidar.onnx``, and
``figures.json`` and ``log.txt``. ``benchmarks/install_networks.py`` compares them with the shipped networks.

Needs the extras ``train`` and ``simulate``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

TRAININGS = ("camera", "lidar", "localizer_kitti", "localizer_nuscenes")
SEEDS = {"lidar": 2001, "camera": 2001, "nuscenes": 2003}
SCALE = 0.67
NUSCENES_EVERY = 6
"""Every so many jobs of a simulating process are a scan of the nuScenes sensor, the others a scan and an image."""
MOST_FAILURES = 20
START_S = 5.0


@dataclass(frozen=True)
class Plan:
    """When what happens, in `time.time`.

    Attributes:
        begin: of everything.
        simulate_until: no sample is begun after that.
        train_until: weights of the trainings are final.
        finish_until: evaluation and export have ended; what still runs is ended then.
    """

    begin: float
    simulate_until: float
    train_until: float
    finish_until: float

    @classmethod
    def of(cls, begin: float, minutes: float) -> Plan:
        """The plan for so many minutes."""
        total = 60 * minutes
        finish, spare = min(60.0, 0.2 * total), min(5.0, 0.03 * total)
        train_until = begin + total - spare - finish
        return cls(begin, train_until - min(25.0, 0.08 * total), train_until, begin + total - spare)


def main() -> None:
    """The whole run, or one of its processes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for what is learned")
    parser.add_argument("--minutes", type=float, default=9.5, help="everything ends within so many minutes")
    parser.add_argument("--work", type=Path, help="folder for samples; default: a temporary one")
    parser.add_argument("--jobs", type=int, default=0, help="simulating processes; default: cores less four")
    parser.add_argument("--device", default="", help="of torch; default: cuda if there is one, else cpu")
    parser.add_argument("--trainings", default=",".join(TRAININGS), help=f"of {', '.join(TRAININGS)}")
    parser.add_argument("--batch", type=float, default=1.0, help="factor on the batch sizes, for small machines")
    parser.add_argument("--needed", type=int, default=100, help="samples that a training waits for")
    parser.add_argument("--weights-only", action="store_true", help="put no ONNX files into OUT")
    parser.add_argument("--begin", type=float, default=0.0, help=argparse.SUPPRESS)
    parser.add_argument("--role", default="", help=argparse.SUPPRESS)
    parser.add_argument("--number", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not options.role:
        conduct(options)
    elif options.role == "simulate":
        simulate(options)
    else:
        train(options)


def conduct(options: argparse.Namespace) -> None:
    """Start the processes, watch them, end them in time."""
    options.begin = options.begin or time.time()
    plan = Plan.of(options.begin, options.minutes)
    unknown = [name for name in options.trainings.split(",") if name not in TRAININGS]
    if unknown:
        raise SystemExit(f"--trainings takes {', '.join(TRAININGS)}, got {unknown[0]!r}")
    options.out.mkdir(parents=True, exist_ok=True)
    options.jobs = options.jobs or max(1, (os.cpu_count() or 1) - 4)
    with tempfile.TemporaryDirectory() as temporary:
        options.work = options.work or Path(temporary)
        for folder in SEEDS:
            (options.work / folder).mkdir(parents=True, exist_ok=True)
        (options.work / "logs").mkdir(exist_ok=True)
        running = {f"simulate{k}": _start(options, "simulate", k) for k in range(options.jobs)}
        options.device = options.device or _device()
        say(options, f"{options.jobs} simulating processes, trainings on {options.device}, {options.minutes:g} minutes")
        trainings = {name: _start(options, name) for name in options.trainings.split(",")}
        try:
            _watch(options, plan, running, trainings)
        finally:
            for process in (*running.values(), *trainings.values()):
                if process.poll() is None:
                    process.kill()
            for process in (*running.values(), *trainings.values()):
                process.wait()
            _gather(options, plan)


def _watch(
    options: argparse.Namespace, plan: Plan, running: dict[str, Any], trainings: dict[str, subprocess.Popen[bytes]]
) -> None:
    """Wait for the trainings; one that fails early is begun again with half its batch."""
    again: set[str] = set()
    told = time.time()
    while time.time() < plan.finish_until and any(p.poll() is None for p in trainings.values()):
        time.sleep(min(1.0, max(0.0, plan.finish_until - time.time())))
        for name, process in list(trainings.items()):
            code = process.poll()
            early = time.time() < plan.begin + 0.6 * (plan.train_until - plan.begin)
            if code not in (None, 0) and name not in again:
                again.add(name)
                say(options, f"{name} failed ({code}): {_tail(options, name)}")
                if early:
                    trainings[name] = _start(options, name, 1)
        if time.time() - told > 15:
            told = time.time()
            counts = {folder: len(list((options.work / folder).glob("[!.]*.npz"))) for folder in SEEDS}
            simulating = sum(p.poll() is None for p in running.values())
            say(options, f"{told - plan.begin:.0f} s: {counts}, {simulating} simulate; {_heads(options, trainings)}")


def _start(options: argparse.Namespace, role: str, number: int = 0) -> subprocess.Popen[bytes]:
    """One of the processes of this script, with its output in a file."""
    command = [sys.executable, __file__, "--role", role, "--number", str(number)]
    for name in ("out", "minutes", "work", "device", "jobs", "batch", "needed", "begin"):
        value = getattr(options, name)
        command += [f"--{name}={value!r}" if isinstance(value, float) else f"--{name}={value}"]
    command += ["--weights-only"] if options.weights_only else []
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    source = str(Path(__file__).parents[1] / "src")
    path = os.pathsep.join([source, *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, **threads, "PYTHONUNBUFFERED": "1", "PYTHONPATH": path}
    if role == "simulate":
        environment["CUDA_VISIBLE_DEVICES"] = ""
    suffix = number if role == "simulate" else ""
    with (options.work / "logs" / f"{role}{suffix}.txt").open("ab") as log:
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)


def _tail(options: argparse.Namespace, name: str, count: int = 600) -> str:
    path = options.work / "logs" / f"{name}.txt"
    return path.read_text(errors="replace")[-count:].strip() if path.is_file() else ""


def _heads(options: argparse.Namespace, trainings: dict[str, Any]) -> str:
    """The last line of each training, shortened."""
    lines = {name: _tail(options, name).split("\n")[-1][:90] for name in trainings}
    return "; ".join(f"{name}: {line}" for name, line in lines.items() if line)


def _gather(options: argparse.Namespace, plan: Plan) -> None:
    """Figures of all trainings in one file, logs in another."""
    figures = {}
    for name in TRAININGS:
        path = options.work / f"{name}.json"
        if path.is_file():
            figures[name] = json.loads(path.read_text())
    figures["samples"] = {folder: len(list((options.work / folder).glob("[!.]*.npz"))) for folder in SEEDS}
    figures["seconds"] = round(time.time() - plan.begin, 1)
    (options.out / "figures.json").write_text(json.dumps(figures, indent=1))
    with (options.out / "log.txt").open("a") as log:
        for path in sorted((options.work / "logs").glob("*.txt")):
            text = path.read_text(errors="replace")
            log.write(f"\n===== {path.stem}\n{text if path.stem in TRAININGS else text[-1500:]}")
    print(json.dumps({**figures, "written": sorted(p.name for p in options.out.iterdir())}, indent=1), flush=True)


def say(options: argparse.Namespace, line: str) -> None:
    """A line of progress, on the screen and in the log."""
    print(line, flush=True)
    with (options.out / "log.txt").open("a") as log:
        log.write(line + "\n")


def _device() -> str:
    """cuda if torch can use it; asked in a process of its own, so that this one holds no memory there."""
    code = "import torch; print('cuda' if torch.cuda.is_available() and torch.zeros(1).cuda() is not None else 'cpu')"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    return "cuda" if answer.stdout.strip().endswith("cuda") else "cpu"


def simulate(options: argparse.Namespace) -> None:
    """Write samples until it is time to stop."""
    os.nice(10)
    from lcf3d.simulation.presets import all_presets
    from lcf3d.training.samples import SampleRecipe, write_scene_samples

    names = all_presets()
    wide = "train_nuscenes" if "train_nuscenes" in names else "nuscenes32"
    lidar = SampleRecipe("lidar", "train_kitti", 1, SEEDS["lidar"])
    camera = SampleRecipe("camera", "train_kitti", 1, SEEDS["camera"], SCALE)
    nuscenes = SampleRecipe("lidar", wide, 1, SEEDS["nuscenes"])
    plan, failures = Plan.of(options.begin, options.minutes), 0
    job = 0
    while time.time() < plan.simulate_until and failures < MOST_FAILURES:
        try:
            if (job + options.number) % NUSCENES_EVERY == NUSCENES_EVERY - 1:
                index = options.number + options.jobs * (job // NUSCENES_EVERY)
                write_scene_samples({options.work / "nuscenes": nuscenes}, index)
            else:
                index = options.number + options.jobs * job
                write_scene_samples({options.work / "lidar": lidar, options.work / "camera": camera}, index)
            failures = 0
        except Exception:
            # one street that cannot be built must not end the process
            failures += 1
            traceback.print_exc()
        job += 1
    print(f"{job} jobs done")


def train(options: argparse.Namespace) -> None:
    """One of the trainings, from its first sample to its finished file."""
    import torch

    from lcf3d.training.clocked import ClockSettings, train_by_clock
    from lcf3d.training.finishing import FINISHERS

    plan, name = Plan.of(options.begin, options.minutes), options.role
    torch.set_num_threads(1)
    share = options.batch * (0.5 if options.number else 1.0)
    task = _task(name, options, share)
    save = min(60.0, 0.15 * 60 * options.minutes)
    settings = ClockSettings(RATES[name], needed=options.needed, save_every=save)
    if name.startswith("localizer"):
        settings = ClockSettings(RATES[name], needed=max(2, options.needed // 5), save_every=save, weight_decay=0.01)
    print(f"training begins after {time.time() - plan.begin:.0f} s", flush=True)
    network = train_by_clock(task, settings, plan.train_until, options.out / f"{name}.pt", options.device, _print)
    torch.set_num_threads(4)
    out = options.work if options.weights_only else options.out
    figures = FINISHERS[name](network.cpu(), task.arrivals.held_out(), out, plan.finish_until - START_S)
    (options.work / f"{name}.json").write_text(json.dumps(figures, indent=1))
    print(json.dumps(figures), flush=True)


RATES = {"camera": 2.5e-3, "lidar": 2.5e-3, "localizer_kitti": 3e-3, "localizer_nuscenes": 3e-3}


def _print(line: str) -> None:
    print(line, flush=True)


def _task(name: str, options: argparse.Namespace, share: float) -> Any:
    """What is trained."""
    from lcf3d.training import arriving

    if name == "camera":
        from lcf3d.detectors.camera.small_network import SmallConfig

        batch = max(2, round(48 * share))
        return arriving.ArrivingCamera(options.work / "camera", SmallConfig(), options.device, batch)
    if name == "lidar":
        from lcf3d.detectors.lidar.presets import COMPACT_KITTI

        batch = max(1, round(12 * share))
        return arriving.ArrivingLidar(options.work / "lidar", COMPACT_KITTI, options.device, batch)
    classes = name.removeprefix("localizer_")
    folder = options.work / ("lidar" if classes == "kitti" else "nuscenes")
    return arriving.localizer_of(classes, folder, max(4, round(96 * share)))


if __name__ == "__main__":
    main()
