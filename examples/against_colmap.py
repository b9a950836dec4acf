"""An independent reference: COLMAP reconstructs the images of a run from scratch.

The reconstruction shares only the images and the calibration with the filter.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from rbpf.runs.files import write_table
from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import MonoRecording, filter_recording
from rbpf.sensors.camera import Pinhole
from rbpf.systems.mono.config import MonoConfig
from rbpf.validation.colmap.compare import ReconstructionOptions, compare_with_colmap
from rbpf.validation.exports import export_colmap, export_ply
from rbpf.validation.report.comparison_pictures import plot_against_colmap
from rbpf.validation.simulation.desk_and_room import TexturedDesk
from rbpf.validation.simulation.images import Imaging, simulate_images


def main(quick: bool = False, out: Path = Path("out")) -> dict[str, float]:
    """Renders a desk, filters it, and compares; writes the run as a COLMAP model and PLY files to `out`."""
    width, frames, every = (320, 90, 9) if quick else (640, 300, 5)
    camera = Pinhole(width, 3 * width // 4, 0.8 * width, 0.8 * width, width / 2 - 0.5, 3 * width / 8 - 0.5)
    with TemporaryDirectory() as folder:
        desk = Path(folder) / "desk"
        world = TexturedDesk(frames=frames, texel_m=0.003 if quick else 0.001)
        simulate_images(world, Imaging(known=6, grid=1 if quick else 2), camera, desk, seed=0)
        run = filter_recording(MonoRecording(desk, desk / "known_points.csv"), MonoConfig())
        estimate = PathAndMap.of_run(run)
        options = ReconstructionOptions(every=every, features=800 if quick else 4096)
        found, truth = compare_with_colmap(estimate, run.source, options)
    figures = {f"run: {name}": value for name, value in found.as_dict().items() if isinstance(value, float)}
    if truth is not None:
        figures["COLMAP's own error [m]"] = truth.path.rmse
    write_table(out / "against_colmap.csv", ("figure", "value"), list(figures.items()))
    plot_against_colmap(found, estimate, out)
    export_colmap(estimate, run.system.measurements(run.name, run.log), out / "colmap")
    export_ply(estimate, out)
    return figures


if __name__ == "__main__":
    main()
