"""The command line: thin, one function per command."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from tyro.extras import SubcommandApp

from rbpf.cli import cameras, exporting, installed, judging
from rbpf.cli.options import ImagesOptions, MonoOptions, Printed
from rbpf.cli.running import RUN, repeated, run_mono
from rbpf.cli.simulating import SIMULATE, simulate_desk
from rbpf.errors import InputError

PROGRAM = "rbpf"
BAD_INPUT, STOPPED = 2, 130
"""Exit codes; 0 is success, 1 a fault of the program."""

APP = SubcommandApp()
_DESCRIPTION = """Rao-Blackwellised particle filters for SLAM. `rbpf COMMAND --help` says more.

Exit codes: 0 success, 1 a fault of the program, 2 bad input (said in one sentence), 130 stopped by Ctrl-C."""


@dataclass(frozen=True, kw_only=True)
class DemoOptions(Printed):
    """Options of `rbpf demo`.

    Attributes:
        out: folder for the images and the results.
        frames: number of images, 30 per second.
    """

    out: Path = Path("demo")
    frames: int = 240


@APP.command(name="demo")
def demo(options: Annotated[DemoOptions, tyro.conf.arg(name="")]) -> None:
    """Render a desk that a camera moves over, run monocular SLAM on the images, leave plots and the annotated video."""
    images = options.out / "desk"
    if not (images / "known_points.csv").is_file():
        simulate_desk(ImagesOptions(out=images, frames=options.frames))
    known = images / "known_points.csv"
    run_mono(MonoOptions(sequence=images, known_points=known, out=options.out / "run", json=options.json))


APP.command(RUN, name="run")
APP.command(SIMULATE, name="simulate")
APP.command(name="calibrate")(cameras.calibrate)
APP.command(name="recalibrate")(cameras.recalibrate)
APP.command(name="validate")(judging.validate)
APP.command(name="report")(judging.report)
APP.command(name="export")(exporting.export)
APP.command(name="sweep")(judging.sweep)
APP.command(name="compare")(judging.compare)
APP.command(name="doctor")(installed.doctor)
APP.command(name="completion")(installed.completion)


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line, runs the command; bad input becomes one sentence and exit code 2."""
    try:
        given = sys.argv[1:] if arguments is None else arguments
        APP.cli(prog=PROGRAM, description=_DESCRIPTION, args=repeated(list(given)))
    except InputError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return BAD_INPUT
    except OSError as error:
        print(
            f"{PROGRAM}: {error}; what was finished is kept, --resume goes on from the last checkpoint",
            file=sys.stderr,
        )
        return BAD_INPUT
    except KeyboardInterrupt as stopped:
        print(f"{PROGRAM}: {stopped or 'stopped'}", file=sys.stderr)
        return STOPPED
    return 0
