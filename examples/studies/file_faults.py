"""Fault injection in files and machines: a damaged recording, a killed run, a full disk.

Folders are those written by the image simulator (EuRoC ASL).
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

LIMITED = (
    "import resource, sys; from rbpf.cli import main; sys.dont_write_bytecode = True; "
    "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2); sys.exit(main(sys.argv[2:]))"
)
"""A program with limited file sizes: writing beyond the limit raises an error, as on a full disk.

It writes no bytecode, which would be truncated silently.
"""

Damage = Callable[[Path], None]


@dataclass(frozen=True)
class Ended:
    """The end of a command: its exit code, and the last line of its standard error."""

    code: int
    said: str
    traceback: bool


def nan_stamp(folder: Path) -> None:
    """The time of the fourth image is not a number."""
    _edit_line(folder / "mav0" / "cam0" / "data.csv", 4, lambda line: "nan," + line.split(",", 1)[1])


def nan_known_point(folder: Path) -> None:
    """A coordinate of the second known point is not a number."""

    def edit(line: str) -> str:
        cells = line.split(",")
        return ",".join([*cells[:3], "nan", *cells[4:]])

    _edit_line(folder / "known_points.csv", 2, edit)


def nan_calibration(folder: Path) -> None:
    """A focal length is not a number."""
    path = folder / "mav0" / "cam0" / "sensor.yaml"
    lines = path.read_text().splitlines(keepends=True)
    row = next(i for i, line in enumerate(lines) if line.startswith("intrinsics"))
    lines[row] = "intrinsics: [.nan, 250.0, 159.5, 119.5]\n"
    path.write_text("".join(lines))


def cut_list(folder: Path) -> None:
    """The list of images ends within a line."""
    _cut(folder / "mav0" / "cam0" / "data.csv")


def cut_known_points(folder: Path) -> None:
    """The table of known points ends within a line."""
    _cut(folder / "known_points.csv")


def cut_image(folder: Path) -> None:
    """The ninth image is truncated."""
    _cut(sorted((folder / "mav0" / "cam0" / "data").iterdir())[8])


def cut_first_image(folder: Path) -> None:
    """The first image is truncated."""
    _cut(sorted((folder / "mav0" / "cam0" / "data").iterdir())[0])


FILE_FAULTS: dict[str, Damage] = {
    "NaN in a stamp": nan_stamp,
    "NaN in a known point": nan_known_point,
    "NaN in the calibration": nan_calibration,
    "list of images truncated": cut_list,
    "known points truncated": cut_known_points,
    "an image truncated": cut_image,
    "the first image truncated": cut_first_image,
}


def damaged_copy(folder: Path, damage: Damage, copy: Path) -> Path:
    """A copy of a recording with one fault."""
    shutil.copytree(folder, copy)
    damage(copy)
    return copy


def run_command(arguments: Sequence[str], most_bytes: int | None = None) -> Ended:
    """Runs `rbpf` in a separate process.

    Args:
        arguments: of the command.
        most_bytes: maximum file size; None is unlimited.
    """
    program = ["-m", "rbpf"] if most_bytes is None else ["-c", LIMITED, str(most_bytes)]
    done = subprocess.run([sys.executable, *program, *arguments], capture_output=True, text=True, check=False)
    lines = [line for line in done.stderr.splitlines() if line.startswith("rbpf: ")]
    return Ended(done.returncode, lines[-1] if lines else "", "Traceback" in done.stderr)


def kill_and_resume(
    arguments: Sequence[str], out: Path, kills: int, rng: np.random.Generator, longest_s: float = 2.0
) -> Ended:
    """Kills a run with checkpoints at random times (SIGKILL), resumes it every time, and finally lets it finish.

    Args:
        arguments: of the command, with a checkpoint every few frames.
        out: the run's folder.
        kills: number of kills.
        rng: draws the times, relative to the run's next checkpoint.
        longest_s: maximum time after that checkpoint.
    """
    checkpoint = out / "checkpoint.npz"
    for _ in range(kills):
        before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
        command = [sys.executable, "-m", "rbpf", *arguments, "--resume"]
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        while process.poll() is None and not (checkpoint.exists() and checkpoint.stat().st_mtime_ns > before):
            time.sleep(0.01)
        time.sleep(rng.uniform(0.0, longest_s))
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
        process.wait()
    return run_command([*arguments, "--resume"])


def _edit_line(path: Path, row: int, edit: Callable[[str], str]) -> None:
    lines = path.read_text().splitlines()
    lines[row] = edit(lines[row])
    path.write_text("\n".join(lines) + "\n")


def _cut(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: 2 * len(data) // 3])
