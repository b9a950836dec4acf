"""Both visual systems with faulty input: dropped frames, darkness, blur, wrong calibration, full disks.

A rendered desk is damaged in all ways of `examples.studies.image_faults` and `examples.studies.file_faults`, and filtered.
The tables have each run's messages, whether it recovered, and its errors; the plot shows the errors.
"""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from re import sub
from typing import Any

import numpy as np
import tyro
from matplotlib.figure import Figure

from examples.studies.file_faults import FILE_FAULTS, Ended, damaged_copy, kill_and_resume, run_command
from examples.studies.image_faults import (
    Fault,
    black_out,
    blur_motion,
    cover_view,
    drop_frames,
    jitter_stamps,
    jump_exposure,
    keep_every,
    salt_and_pepper,
    truncate_files,
    wrong_focal,
)
from examples.studies.mono_blackouts import pose_differences
from rbpf.cli import main as run_cli
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.recordings import filter_opened, open_mono, open_pairs
from rbpf.runs.truth import truth_at
from rbpf.sensors.camera import Pinhole, RectifiedStereo
from rbpf.sensors.readers import ImageSequence, KnownPixels, open_images, open_stereo, read_known_points
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images

NONE = "none"
RIGHT_M, RIGHT_DEG = 0.03, 2.0
"""Largest excess of a correct pose's error over that of the undamaged run."""

END = 10
"""Frames at the end whose median error decides whether a run has recovered."""


@dataclass(frozen=True)
class Told:
    """A run's own report.

    Attributes:
        stamps_ns: (T,) of the filtered frames.
        poses: (T, 7) in the truth's world.
        lost: (T,) frames of reported tracking loss.
        problems: its messages.
        failure: the reason of an early end.
    """

    stamps_ns: np.ndarray
    poses: np.ndarray
    lost: np.ndarray
    problems: list[str]
    failure: str | None


@dataclass(frozen=True)
class Outcome:
    """A fault and its outcome.

    Attributes:
        system: that ran.
        fault: of its input.
        frames: filtered frames of the damaged sequence.
        lost: number of frames of reported tracking loss.
        rmse_m: error of the position over all frames.
        last_m: median error of the last frames; NaN where there are none.
        last_deg: of the rotation.
        verdict: "as without", "recovers", "lost", "wrong" (and does not know it), "stopped" or "refused".
        said: the run's messages, each once.
    """

    system: str
    fault: str
    frames: int
    lost: int
    rmse_m: float
    last_m: float
    last_deg: float
    verdict: str
    said: str


def usual_faults(rate_hz: float, frames: int) -> dict[str, Fault]:
    """The faults reported in the documentation, for a recording of about five seconds."""
    second, first = round(rate_hz), 2 * frames // 5
    return {
        "10 % of the frames dropped": drop_frames(0.1),
        "30 % of the frames dropped": drop_frames(0.3),
        "10 % of the files truncated": truncate_files(0.1),
        "1 s blackout": black_out(first, second),
        "exposure jumps, x0.4 to x1.8, every 0.5 s": jump_exposure(max(second // 2, 1)),
        "1 s of motion blur, 15 px": blur_motion(15, first, second),
        "5 px of motion blur throughout": blur_motion(5),
        "salt and pepper, 2 %": salt_and_pepper(0.02),
        "a third covered by a moving object, 2 s": cover_view(1 / 3, first, 2 * second),
        "focal length 2 % too long": wrong_focal(1.02),
        "focal length 10 % too long": wrong_focal(1.1),
        "stamps with 5 ms of jitter": jitter_stamps(0.005),
    }


def try_mono(
    sequence: ImageSequence,
    known: KnownPixels | None,
    config: MonoConfig,
    faults: Mapping[str, Fault],
    name: str = "mono",
) -> list[Outcome]:
    """Runs the monocular system on a sequence with ground truth, undamaged first; with known points, without alignment.

    Raises:
        InputError: the sequence has no ground truth.
    """

    def run(damaged: ImageSequence) -> Told:
        done = filter_opened(open_mono(damaged, config, known))
        return Told(done.log.stamps_ns, done.log.poses, done.log.lost(), done.messages, done.failure)

    return _try_all(name, sequence, run, faults)


def try_stereo(sequence: ImageSequence, config: StereoConfig, faults: Mapping[str, Fault]) -> list[Outcome]:
    """Runs the stereo system on a sequence with ground truth, undamaged first; the first true camera is the world.

    Raises:
        InputError: the sequence has no ground truth.
    """

    def run(damaged: ImageSequence) -> Told:
        done = filter_opened(open_pairs(damaged, config))
        log, blind = done.log, done.log["assumed"] > 0
        poses = SE3.compose(_truth(damaged, log.stamps_ns)[0], log.poses)
        return Told(log.stamps_ns, poses, blind, done.messages, done.failure)

    return _try_all("stereo", sequence, run, faults)


def _try_all(system: str, sequence: Any, run: Callable[[Any], Told], faults: Mapping[str, Fault]) -> list[Outcome]:
    clean = judged(system, NONE, sequence, run, None)
    return [clean, *(judged(system, name, fault(sequence), run, clean) for name, fault in faults.items())]


def judged(system: str, fault: str, damaged: Any, run: Callable[[Any], Told], clean: Outcome | None) -> Outcome:
    """Runs one damaged sequence.

    Args:
        system: its name.
        fault: the fault's name.
        damaged: the sequence.
        run: filters it.
        clean: the outcome without a fault; None if this is that run.
    """
    try:
        told = run(damaged)
    except InputError as error:
        nan = float("nan")
        return Outcome(system, fault, 0, 0, nan, nan, nan, "refused", str(error))
    metres, degrees = pose_differences(told.poses, _truth(damaged, told.stamps_ns))
    outcome = Outcome(
        system=system,
        fault=fault,
        frames=told.stamps_ns.size,
        lost=int(told.lost.sum()),
        rmse_m=float(np.sqrt(np.square(metres).mean())),
        last_m=float(np.median(metres[-END:])),
        last_deg=float(np.median(degrees[-END:])),
        verdict="as without",
        said="; ".join(summarised(told.problems + ([told.failure] if told.failure else []))),
    )
    return replace(outcome, verdict=_verdict(outcome, told, clean))


def _verdict(outcome: Outcome, told: Told, clean: Outcome | None) -> str:
    if told.failure is not None:
        return "stopped"
    if told.lost[-1]:
        return "lost"
    least_m, least_deg = (0.0, 0.0) if clean is None else (clean.last_m, clean.last_deg)
    if outcome.last_m > least_m + RIGHT_M or outcome.last_deg > least_deg + RIGHT_DEG:
        return "wrong"
    return "recovers" if outcome.lost > (0 if clean is None else clean.lost) else "as without"


def summarised(problems: list[str]) -> list[str]:
    """Each message once, without frame numbers, and its count."""
    counts = Counter(sub(r"^(frame|pair) \d+( of [^:]*)?:? ", "", problem) for problem in problems)
    return [text if count == 1 else f"{text} (x{count})" for text, count in counts.items()]


def _truth(sequence: ImageSequence, stamps_ns: np.ndarray) -> np.ndarray:
    truth = None if sequence.truth is None else truth_at(SE3, sequence.truth, stamps_ns, "none")
    if truth is None:
        raise InputError(f"{sequence.name} has no ground truth to judge a damaged run by")
    rows = np.clip(np.searchsorted(truth.rows, np.arange(stamps_ns.size)), 0, truth.rows.size - 1)
    return truth.poses[rows]


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


def main(frames: int = 150, kills: int = 5, out: Path = Path("demo/faults"), quick: bool = False) -> dict[str, float]:
    """Renders, damages, runs and prints both tables.

    Args:
        frames: of the monocular sequence, at 30 Hz; the stereo one has every second of them.
        kills: number of times that a run is killed and resumed.
        out: folder for recording, tables and picture.
        quick: a few frames, one image fault and one kill; other runs are in this process.
    """
    frames, kills = (16, 1) if quick else (frames, kills)
    desk = out / f"desk_{frames}"
    if not desk.exists():
        simulate_images(TexturedDesk(frames=frames, texel_m=0.003), Imaging(), RIG, desk, seed=1)
    outcomes = of_images(desk, quick)
    cells = [[o.system, o.fault, o.verdict, o.lost, 1e3 * o.rmse_m, 1e3 * o.last_m, o.last_deg] for o in outcomes]
    header = ["system", "fault", "outcome", "frames lost", "error [mm]", "at the end [mm]", "[deg]"]
    write_table(out / "images.csv", header, cells)
    write_table(
        out / "said.csv",
        ["system", "fault", "what is said"],
        [[o.system, o.fault, o.said] for o in outcomes],
        shown=False,
    )
    draw(outcomes, out / "faults.png")
    machine = of_machine(desk, out, kills, quick)
    write_table(out / "machine.csv", MACHINE, [[name, e.code, str(e.traceback), e.said] for name, e in machine.items()])
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
        faults = {name: faults[0][name] for name in list(faults[0])[:1]}, {}
    focal = {name: fault for name, fault in faults[0].items() if name.startswith("focal")}
    calibrating = (
        try_mono(mono, known, MonoConfig(calibrate="online"), focal, "mono, calibrate=online") if focal else []
    )
    return [
        *try_mono(mono, known, MonoConfig(), faults[0]),
        *calibrating,
        *try_stereo(stereo, StereoConfig(), faults[1]),
    ]


def of_machine(desk: Path, out: Path, kills: int, quick: bool) -> dict[str, Ended]:
    """The monocular command on damaged files, on full disks, and killed."""
    chosen = [] if quick else list(FILE_FAULTS.items())
    ended = {}
    for number, (name, damage) in enumerate(chosen):
        copy = out / f"damaged_{os.getpid()}_{number}"
        ended[name] = run_command(command(damaged_copy(desk, damage, copy), out / f"run_{number}"))
    every = ["--set", "checkpoint_every=3"]
    whole = [*command(desk, out / "whole"), *every]
    ended["undisturbed"] = Ended(run_cli(whole), "", False) if quick else run_command(whole)
    for limit in [] if quick else [20_000, 200_000, 2_000_000]:
        ended[f"no file beyond {limit // 1000} kB"] = run_command(command(desk, out / f"full_{limit}"), limit)
    killed = kill_and_resume([*command(desk, out / "killed"), *every], out / "killed", kills, np.random.default_rng(0))
    return ended | {f"killed {kills} times (SIGKILL) and resumed": killed}


def command(folder: Path, out: Path) -> list[str]:
    """`rbpf run mono` without slow outputs."""
    known = ["--known-points", str(folder / "known_points.csv")]
    return ["run", "mono", str(folder), *known, "--out", str(out), "--particles", "20", "--no-video", "--no-batch"]


def same_path(whole: Path, resumed: Path) -> bool:
    """Whether two runs have the same path, to the byte."""
    name = "trajectory.tum"
    return (resumed / name).exists() and (whole / name).read_bytes() == (resumed / name).read_bytes()


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Plots the error over the whole run and at its end, for each fault; coloured by outcome."""
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
