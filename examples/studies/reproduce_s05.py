"""Reproduction of R. Sim et al. (2005) in the simulated laboratory: Table I, maps (Figs. 4–6), time per frame (Fig. 7).

The whole tour is 4,000 pairs over 68 m. It is rendered once (OUT/lab, ten minutes of one core) and its features are
measured once (OUT/features, five minutes; continued after an interruption); the filter takes some minutes. --frames
shortens the tour, --every subsamples it, --sweep-frames filters its first pairs with other settings.

The map of the best particle is its own. The maps of odometry alone, visual or of the wheels, average the filter's
observations along the odometry's path: they differ only by the paths. Errors are of landmark positions relative to those
along the true path, in metres, first in the world of the first camera, then after rigid alignment.
"""

from pathlib import Path

import numpy as np
import tyro

from examples.studies.feature_cache import filter_cached
from examples.studies.s05.drive import Setting, measured_drive
from examples.studies.s05.pictures import draw_errors, draw_maps, draw_time
from examples.studies.s05.record import Paths, Record, best_particle, errors, paths_of
from examples.studies.s05.sweeps import HEADER, sweep
from rbpf.lie import SE3
from rbpf.runs.files import write_table
from rbpf.runs.run import Run

PAPER = {191: (812, 0.62, 2109), 400: (1542, 4.02, 4194), 600: (2206, 6.87, 6264), 800: (2625, 11.48, 7674),
         997: (3103, 14.98, 9399), 1200: (3773, 18.69, 11424), 1396: (4353, 22.22, 13254),
         1600: (4857, 26.01, 15264), 1800: (5379, 29.25, 17259), 1998: (6213, 31.11, 19869),
         2200: (6689, 34.37, 21594), 2400: (7155, 38.07, 23259), 2600: (7769, 41.02, 25359),
         2797: (8355, 43.58, 27369), 3000: (8608, 48.64, 28719), 3199: (9065, 52.05, 30639),
         3400: (9694, 54.83, 32874), 3600: (10056, 58.82, 34404), 3796: (10595, 61.94, 36384),
         4000: (11085, 65.71, 38394)}  # fmt: skip
"""Table I: frame → landmarks per particle, distance by the wheels [m], SIFT features."""

PAPER_SECONDS = 11.9

EARLY, LAST = (350, 450), 100
"""Frames of the tour around frame 400, and number of last ones, for the time of an update in a small and a large map."""


def main(
    out: Path = Path("demo/reproduce_s05"),
    frames: int = 4000,
    every: int = 1,
    particles: int = 400,
    dof: int = 3,
    width: int = 640,
    trigger_m: float = 0.015,
    seed: int = 0,
    sweep_frames: int = 0,
    sweep_seeds: int = 3,
    quick: bool = False,
) -> dict[str, float]:
    """Renders the drive and measures its features, unless they exist, and filters it.

    Args:
        out: folder for images, features, tables and plots.
        frames: number of pairs, from the start of the tour.
        every: every n-th frame is a pair.
        particles: number of particles.
        dof: degrees of freedom; the paper's are 3.
        width: of the images, px.
        trigger_m: distance between updates.
        seed: of the images and of the filter.
        sweep_frames: number of first pairs that are also filtered with other settings.
        sweep_seeds: number of seeds of the filter for each of these.
        quick: thirty small pairs and 100 particles, as a check.
    """
    setting = Setting(out, frames, every, width, 0.003, particles, dof, trigger_m, seed)
    if quick:
        setting = Setting(out, 30, 3, 320, 0.01, 100, dof, trigger_m, seed)
    drive = measured_drive(setting, told)
    due = {round(frame / setting.every): frame for frame in PAPER}
    record = Record(tuple(due))
    run = filter_cached(drive, setting.config(), [record])
    paths, best = paths_of(run, setting.images), best_particle(run)
    table_1(record, paths, due, out)
    figures = errors(record, paths, best, run.log["updated"])
    features = np.array([pair.seconds for pair in drive.frames()])
    figures |= times(run, features, np.array(record.cpu), setting.every)
    write_table(out / "figures.csv", ["what", "m, s"], list(figures.items()))
    draw_maps(record, paths, best, out / "maps.png")
    draw_errors(paths, run.log.stamps_ns, out / "errors.png")
    draw_time(run, features, out / "time.png")
    if sweep_frames:
        rows = list(sweep(drive.first(sweep_frames), setting.config(), range(sweep_seeds)))
        write_table(out / "sweep.csv", HEADER, rows)
    return figures


def told(what: str, done: int, total: int) -> None:
    """Reports progress at intervals."""
    if done % 200 == 0 or done == total:
        print(f"{what}: {done} of {total} pairs", flush=True)


def table_1(record: Record, paths: Paths, due: dict[int, int], out: Path) -> None:
    """Our Table I and the paper's; `due` maps a number of pairs to its frame."""
    lengths = np.linalg.norm(np.diff(SE3.translation(paths.wheels), axis=0), axis=1)
    header = ["pairs", "paper's frame", "landmarks", "paper's", "distance m", "paper's", "SIFT features", "paper's"]
    rows = []
    for row in record.rows:
        frame = due.get(row.pairs, "")
        theirs = PAPER[frame] if frame else ("", "", "")
        ours = row.landmarks, float(lengths[: row.pairs - 1].sum()), row.features
        cells = [cell for pair in zip(ours, theirs, strict=True) for cell in pair]
        rows.append([row.pairs, frame, *cells])
    write_table(out / "table1.csv", header, rows)


def times(run: Run, features: np.ndarray, cpu: np.ndarray, every: int) -> dict[str, float]:
    """Means over the pairs; medians over the updates about frame 400, if the tour goes as far, and at its end."""
    log = run.log
    updated, matching = log["updated"], 1e3 * log["seconds_matching"]
    update = matching + 1e3 * log["seconds_filter"]
    out = {
        "pairs": float(updated.size),
        "updates": float(updated.sum()),
        "mean seconds per pair": float((log["seconds"] + features).mean()),
        "mean processor seconds per pair": float((cpu + features).mean()),
        "the paper's": PAPER_SECONDS,
        "mean ms of an update": float(update[updated].mean()),
    }
    pairs = np.arange(updated.size)
    early = (pairs >= EARLY[0] // every) & (pairs < EARLY[1] // every)
    for name, rows in (("frame 400", early), ("the end", pairs >= updated.size - max(LAST // every, 1))):
        rows = rows & updated
        if rows.any():
            out[f"median ms of an update, {name}"] = float(np.median(update[rows]))
            out[f"of it matching, {name}"] = float(np.median(matching[rows]))
            out[f"landmarks seen in an update, {name}"] = float(np.median(log["observed"][rows]))
    return out


if __name__ == "__main__":
    tyro.cli(main)
