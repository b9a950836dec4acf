"""`rbpf export`: a run in the formats of other programs."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from rbpf.cli.options import Printed, Where
from rbpf.cli.showing import answer

Format = Literal["tum", "kitti", "ply", "colmap", "rerun", "npz"]


@dataclass(frozen=True, kw_only=True)
class ExportOptions(Printed):
    """Options of `rbpf export`.

    Attributes:
        run: folder that `rbpf run` left.
        format: one or several: trajectory as TUM or KITTI, map and path as PLY, a COLMAP model, a Rerun recording,
            everything as one NumPy archive.
        out: folder for the files; by default RUN/export.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    format: tuple[Format, ...]
    out: Where = None


def export(options: Annotated[ExportOptions, tyro.conf.arg(name="")]) -> None:
    """Write a run in the formats of other programs."""
    from rbpf.validation.exports import export_run

    out = options.out or options.run / "export"
    paths = [str(path) for path in export_run(options.run, options.format, out)]
    answer({"files": paths}, options.json, *(f"wrote {path}" for path in paths))
