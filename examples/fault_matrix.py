"""What the two visual systems make of damaged input: dropped frames, darkness, blur, wrong calibration, full disks.

A rendered desk is damaged in every way that `rbpf.validation.image_faults` and `rbpf.validation.file_faults` know, and
run. The tables say what each run said, whether it recovered, and how far off it was; the picture has the errors.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure

from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers.images import open_images, open_stereo, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.fault_matrix import Outcome, try_mono, try_stereo, usual_faults
from rbpf.validation.file_faults import FILE_FAULTS, Ended, damaged_copy, kill_and_resume, run_command
from rbpf.validation.image_faults import keep_every
from rbpf.validation.simulation.exposure import Imaging
from rbpf.validation.simulation.images import simulate_images
from rbpf.validation.simulation.textured_desk import TexturedDesk
from rbpf.validation.tables import write_csv, write_table

RIG = RectifiedStereo(Pinhole(320, 240, 250.0, 250.0, 159.5, 119.5), 0.12)
RATE_HZ = 30.0
COLOURS = {
    "as without": "tab:green",
    "recovers": "tab:blue",
    "lost": "tab:orange",
    "wrong": "tab:red",
    "stopped": "tab:purple",
    "refused": "tab:grey",
}
MACHINE = ["fault", "exit code", "traceback", "what is said"]


def main(
    frames: int = 150, kills: int = 5, out: Path = Path("demo/faults"), quick: bool = False
) -> dict[str, float]:
    """Renders, damages, runs and prints both tables.

    Args:
        frames: of the monocular sequence, at 30 Hz; the stereo one has every second of them.
        kills: how often a run is killed and resumed.
        out: folder for recording, tables and picture.
        quick: a few frames and faults.
    """
    frames, kills = (16, 1) if quick else (frames, kills)
    desk = out / f"desk_{frames}"
    if not desk.exists():
        simulate_images(TexturedDesk(frames=frames, texel_m=0.003), Imaging(), RIG, desk, seed=1)
    outcomes = of_images(desk, quick)
    cells = [
        [o.system, o.fault, o.verdict, o.lost, 1e3 * o.rmse_m, 1e3 * o.last_m, o.last_deg] for o in outcomes
    ]
    header = ["system", "fault", "outcome", "frames lost", "error [mm]", "at the end [mm]", "[deg]"]
    write_table(out / "images.csv", header, cells)
    write_csv(
        out / "said.csv", ["system", "fault", "what is said"], [[o.system, o.fault, o.said] for o in outcomes]
    )
    draw(outcomes, out / "faults.png")
    machine = of_machine(desk, out, kills, quick)
    write_table(
        out / "machine.csv",
        MACHINE,
        [[name, e.code, str(e.traceback), e.said] for name, e in machine.items()],
    )
    same = same_path(out / "whole", out / "killed")
    print(f"the killed run's path is {'' if same else 'not '}that of the undisturbed one, to the byte")
    print(f"tables and picture in {out}")
    return {
        "tracebacks": float(sum(ended.traceback for ended in machine.values())),
        "resumed as uninterrupted": float(same),
        **{f"{o.system}: {o.fault}: {o.verdict}": o.last_m for o in outcomes},
    }


def of_images(desk: Path, quick: bool) -> list[Outcome]:
    """Both systems with every fault of the images."""
    mono, stereo = open_images(desk), keep_every(2)(open_stereo(desk))
    known = read_known_points(desk / "known_points.csv")
    faults = usual_faults(RATE_HZ, len(mono)), usual_faults(RATE_HZ / 2, len(stereo))
    if quick:
        faults = {name: faults[0][name] for name in list(faults[0])[:2]}, {}
    config = replace(StereoConfig(), particles=100)
    return [*try_mono(mono, known, MonoConfig(), faults[0]), *try_stereo(stereo, config, faults[1])]


def of_machine(desk: Path, out: Path, kills: int, quick: bool) -> dict[str, Ended]:
    """The monocular command on damaged files, on full disks, and killed."""
    chosen = list(FILE_FAULTS.items())[: 1 if quick else None]
    ended = {}
    for number, (name, damage) in enumerate(chosen):
        copy = out / f"damaged_{os.getpid()}_{number}"
        ended[name] = run_command(command(damaged_copy(desk, damage, copy), out / f"run_{number}"))
    every = ["--set", "checkpoint_every=3"]
    ended["undisturbed"] = run_command([*command(desk, out / "whole"), *every])
    for limit in [20_000] if quick else [20_000, 200_000, 2_000_000]:
        ended[f"no file beyond {limit // 1000} kB"] = run_command(command(desk, out / f"full_{limit}"), limit)
    killed = kill_and_resume(
        [*command(desk, out / "killed"), *every], out / "killed", kills, np.random.default_rng(0)
    )
    return ended | {f"killed {kills} times (SIGKILL) and resumed": killed}


def command(folder: Path, out: Path) -> list[str]:
    """`rbpf run mono` without what takes long."""
    known = ["--known-points", str(folder / "known_points.csv")]
    return [
        "run",
        "mono",
        str(folder),
        *known,
        "--out",
        str(out),
        "--particles",
        "20",
        "--no-video",
        "--no-batch",
    ]


def same_path(whole: Path, resumed: Path) -> bool:
    """Whether two runs tell the same path, to the byte."""
    name = "trajectory.tum"
    return (resumed / name).exists() and (whole / name).read_bytes() == (resumed / name).read_bytes()


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """The error over the whole run, and at its end, for each fault; coloured by the outcome."""
    systems = dict.fromkeys(outcome.system for outcome in outcomes)
    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    for axes, system in zip(figure.subplots(len(systems), 1, squeeze=False)[:, 0], systems, strict=True):
        shown = [outcome for outcome in outcomes if outcome.system == system]
        places = np.arange(len(shown))
        axes.barh(places, [o.rmse_m for o in shown], color=[COLOURS[o.verdict] for o in shown])
        axes.plot([o.last_m for o in shown], places, "k|", ms=10, label="at the end")
        axes.set_yticks(places, [f"{o.fault} ({o.verdict})" for o in shown], fontsize="small")
        axes.invert_yaxis()
        axes.set(xlabel="RMS error [m]", title=system, xscale="log")
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    tyro.cli(main)
