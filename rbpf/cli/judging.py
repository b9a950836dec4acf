"""Commands about finished runs: compare them with something, build their page, sweep over settings."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.console import Console

if TYPE_CHECKING:
    from rbpf.validation.verdict import Verdict

CONSOLE = Console(stderr=True)


@dataclass(frozen=True)
class ValidateOptions:
    """Options of `rbpf validate`.

    Attributes:
        run: folder that `rbpf run` left.
        against: ground truth of the recording, batch optimum of the same measurements, or a reconstruction.
        out: a further folder for the JSON; one is always written into the run's own.
    """

    run: tyro.conf.Positional[Path]
    against: Literal["groundtruth", "gtsam", "colmap"] = "groundtruth"
    out: Path | None = None


def validate(options: Annotated[ValidateOptions, tyro.conf.arg(name="")]) -> None:
    """Compare a run with the truth or an optimum: JSON, pictures, and two sentences on top of its report."""
    from rbpf.validation.validate import validate as compare

    _say(compare(options.run, options.against, options.out), options.run)


def report(run: tyro.conf.Positional[Path]) -> None:
    """Build the report of a run again, from the files in its folder.

    Args:
        run: folder that `rbpf run` left.
    """
    from rbpf.validation.report import write_report

    _say(write_report(run), run)


def _say(verdict: "Verdict", run: Path) -> None:
    for sentence in verdict.sentences:
        CONSOLE.print(sentence, highlight=False)
    CONSOLE.print(f"the page is {run / 'report.html'}")
