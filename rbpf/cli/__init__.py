"""The command line: a thin layer, one class per command."""

import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated

# Before NumPy is imported (nothing above does): a filter's matrices are small, and waiting BLAS threads double a run's time
# if other programs use the cores. The last digits of large products depend on their number.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

from rbpf import __version__
from rbpf.cli import cameras, installed, judging
from rbpf.cli.commands import Commands
from rbpf.cli.options import Printed
from rbpf.cli.running import RUN, FilterOptions, ImageResultOptions, RunMono, WorldOptions, repeated
from rbpf.cli.showing import say
from rbpf.cli.simulating import SIMULATE, SimulateDesk
from rbpf.errors import InputError
from rbpf.ranges import MOST, Range

PROGRAM = "rbpf"
BAD_INPUT, STOPPED = 2, 130  #: Exit codes; 0 is success, 1 a fault of the program.


@dataclass(frozen=True, kw_only=True)
class Demo(Printed):
    """Render images of a desk, run monocular SLAM on them, and write plots and the annotated video."""

    out: Path = Path("demo")  #: folder for the images and the results.
    frames: Annotated[int, Range(ge=2, le=MOST)] = 240  #: number of images, 30 per second.

    def __call__(self) -> None:
        images = self.out / "desk"
        known = images / "known_points.csv"
        if not known.is_file():
            SimulateDesk(out=images, frames=self.frames)()
        made = ImageResultOptions(out=self.out / "run", overwrite=True)
        # In rendered images features are matched to hundredths of a pixel, unlike in a camera's.
        noise = FilterOptions(set=("search.noise_px=0.1", "search.planes=learnt", "noise=learnt"))
        RunMono(sequence=images, world=WorldOptions(known_points=known), result=made, filter=noise, json=self.json)()


APP = Commands(
    """Rao-Blackwellised particle filters for SLAM. `rbpf COMMAND --help` says more.

  try it:    rbpf demo
  record:    rbpf simulate desk --out desk
  camera:    rbpf calibrate board.mp4 --board 9x6 --square 0.024; rbpf recalibrate RUN
  run:       rbpf run mono desk --known-points desk/known_points.csv --out RUN --view
  look:      rbpf report RUN; rbpf plot RUN OTHER; rbpf export RUN --format tum ply
  check:     rbpf validate RUN --against gtsam; rbpf compare RUN OTHER; rbpf sweep plan.yaml
  machine:   rbpf doctor; eval "$(rbpf completion bash)"

Exit codes: 0 success, 1 a fault of the program, 2 bad input (explained in one sentence), 130 stopped by Ctrl-C.""",
    {
        "demo": Demo,
        "simulate": SIMULATE,
        "calibrate": cameras.Calibrate,
        "recalibrate": cameras.Recalibrate,
        "run": RUN,
        "report": judging.Report,
        "plot": judging.Plot,
        "export": judging.Export,
        "validate": judging.Validate,
        "compare": judging.Compare,
        "sweep": judging.Sweep,
        "doctor": installed.Doctor,
        "completion": installed.Completion,
    },
)


def _require_streams(wanted: bool) -> None:
    """Reopens closed standard streams (`>&-`) on the null device: else the next opened file would take their place."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)
            setattr(sys, name, open(os.devnull, "w" if number else "r", encoding="utf-8"))  # noqa: SIM115
            if number == 1 and wanted:
                raise InputError("standard output is closed: --json has nowhere to write to")


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, runs the command; bad input becomes one sentence and exit code 2."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        _require_streams("--json" in given)
        if given == ["--version"]:
            print(f"{PROGRAM} {__version__}", flush=True)
            return 0
        # An empty name would mean the current folder.
        for before, word in pairwise(["", *given]):
            option, equals, value = word.partition("=")
            if not word or (option.startswith("--") and equals and not value):
                named = before if not word else option
                raise InputError(f"{named} is empty" if named.startswith("--") else "an argument is empty")
        # Numba fails or misbehaves with other values.
        threads = os.environ.get("NUMBA_NUM_THREADS", "1")
        if not (threads.isdecimal() and int(threads) >= 1):
            raise InputError(f"the environment's NUMBA_NUM_THREADS must be a whole number from 1 up, got {threads!r}")
        APP.call(repeated(given), PROGRAM)
        sys.stdout.flush()  # so that a broken pipe is noticed here
    except InputError as error:
        say(f"{PROGRAM}: {error}")
        return BAD_INPUT
    except BrokenPipeError:
        # The reader has closed the pipe; discard what Python would still write.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        kept = "; what was finished is kept, --resume goes on from the last checkpoint"
        say(f"{PROGRAM}: {error}{kept if given[:1] == ['run'] else ''}")
        return BAD_INPUT
    except KeyboardInterrupt as stopped:
        say(f"{PROGRAM}: {str(stopped) or 'stopped'}")
        return STOPPED
    return 0
