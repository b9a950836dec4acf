"""Benefit of the map: each recording without and with a map, and played forwards and then backwards.

On the way back all landmarks are re-observed. Odometry is that of the same runs, from the same features. Recordings are
in the folder of the environment variable RBPF_DATA; missing ones are skipped. The recorded tracks have no ground truth,
and are compared with the batch optimum of the same pixels. Pixels of the simulated laboratory are always in the table.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import final

import numpy as np
import tyro

from examples.studies.feature_cache import cache_features, filter_cached
from examples.studies.lab import LabDrive
from examples.studies.point_worlds import STEREO, LabWorld, Measuring, simulate_features
from examples.studies.stereo_tracks import read_stereo_tracks
from rbpf.errors import InputError
from rbpf.runs.files import write_table
from rbpf.runs.plots import COLOURS, new_axes, save_figures
from rbpf.runs.recordings import filter_features
from rbpf.runs.run import Run
from rbpf.runs.trajectory import in_space
from rbpf.sensors.feature_log import FeatureLog, Truth
from rbpf.sensors.readers import ImageSequence, open_stereo
from rbpf.sensors.readers.images.sequence import ImageFrame, Source
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.gtsam.batch_problem import solve_problem
from rbpf.validation.metrics.scores import score_path


@final
class Reordered(Source):
    """Images of a sequence in another order, with given times; all are in memory.

    Args:
        sequence: of pairs.
        rows: (T,) indices of its pairs.
        stamps_ns: (T,) their times.
    """

    def __init__(self, sequence: ImageSequence, rows: np.ndarray, stamps_ns: np.ndarray) -> None:
        self.images = list(sequence.frames())
        self.rows, self.stamps_ns = rows, stamps_ns

    def frames(self, start: int) -> Iterator[ImageFrame]:
        """Images from number `start` on."""
        for row, stamp in zip(self.rows[start:].tolist(), self.stamps_ns[start:].tolist(), strict=True):
            yield replace(self.images[row], stamp_ns=stamp)


def pairs_there_and_back(sequence: ImageSequence) -> ImageSequence:
    """T pairs, then T − 1 backwards, at constant rate.

    Raises:
        InputError: the recording has no truth, or less than two pairs.
    """
    count, truth = len(sequence), sequence.truth
    if truth is None or count < 2:
        raise InputError(f"{sequence.name}: expected two pairs or more, and ground truth")
    rows = there_and_back(count)
    stamps = np.arange(rows.size, dtype=np.int64) * int(np.median(np.diff(sequence.stamps_ns)))
    near = np.array([int(np.abs(truth.stamps_ns - stamp).argmin()) for stamp in sequence.stamps_ns.tolist()])
    true = Truth(stamps, truth.poses[near][rows])
    source = Reordered(sequence, rows, stamps)
    return replace(sequence, stamps_ns=stamps, truth=true, source=source)


def log_there_and_back(log: FeatureLog) -> FeatureLog:
    """T frames, then T − 1 backwards; stamps count them. Ground truth, if any, has a pose for each frame."""
    rows = there_and_back(len(log.frames))
    frames = [replace(log.frames[row], stamp_ns=t) for t, row in enumerate(rows.tolist())]
    truth = log.truth
    if truth is not None:
        stamps = np.arange(rows.size, dtype=np.int64)
        truth = Truth(stamps, truth.poses[rows], truth.landmarks)
    return replace(log, frames=frames, truth=truth)


def there_and_back(count: int) -> np.ndarray:
    """0 … T − 1 … 0, (2 T − 1,)."""
    return np.concatenate([np.arange(count), np.arange(count - 2, -1, -1)])


PAIRS, TRACKS = ("stereo_zed_room1", "stereo_kitti_seq1"), "gtsam_stereo_vo"
HEADER = ("recording", "odometry", "filter", "least", "most", "Sim(3): odometry", "filter")
WAYS = "there", "there and back"


def main(quick: bool = False, out: Path = Path("out"), seeds: int = 5, particles: int = 400) -> dict[str, float]:
    """Prints a table of medians over the seeds, metres, and writes it to a folder; `quick` simulates a short path."""
    out.mkdir(parents=True, exist_ok=True)
    configs = [replace(StereoConfig.s05(), particles=particles, seed=seed) for seed in range(1 if quick else seeds)]
    rows = list(simulated(configs, 20 if quick else 60))
    if not quick:
        rows += recorded(Path(os.environ.get("RBPF_DATA", "../shared/data")), configs)
    write_table(out / "stereo_revisit.csv", HEADER, rows)
    save_figures({"stereo_revisit.png": picture(rows)}, out)
    return {f"{row[0]}: {what}": row[at] for row in rows for at, what in ((1, "odometry"), (2, "filter"))}


def simulated(configs: Sequence[StereoConfig], frames: int) -> Iterator[list]:
    """Pixels of the laboratory, 0.3 px, known association."""
    world = LabWorld(LabDrive(frames=frames, every=4), points=8000)
    measuring = Measuring(noise_px=0.3, measurements=40, known=0, new_per_frame=20)
    yield from of_tracks(simulate_features(world, measuring, STEREO, seed=0), configs)


def recorded(data: Path, configs: Sequence[StereoConfig]) -> Iterator[list]:
    """The available recordings."""
    for name in PAIRS:
        if (data / name).is_dir():
            yield from of_pairs(data / name, configs)
    if (data / TRACKS).is_dir():
        tracks = read_stereo_tracks(data / TRACKS)
        batch = solve_problem(tracks.log, tracks.world_from_camera, marginals=False).estimate
        truth = Truth(batch.trajectory.stamps_ns, batch.world_from_body)
        yield from of_tracks(replace(tracks.log, truth=truth), configs)


def of_pairs(folder: Path, configs: Sequence[StereoConfig]) -> Iterator[list]:
    """Images, measured once."""
    sequence = open_stereo(folder)
    with TemporaryDirectory() as features:
        both = cache_features(pairs_there_and_back(sequence), configs[0], Path(features))
        for way, part in zip(WAYS, (both.first(len(sequence)), both), strict=True):
            yield row(f"{sequence.name}, {way}", lambda config, part=part: filter_cached(part, config), configs)


def of_tracks(log: FeatureLog, configs: Sequence[StereoConfig]) -> Iterator[list]:
    """Named pixels."""
    for way, part in zip(WAYS, (log, log_there_and_back(log)), strict=True):
        yield row(f"{log.name}, {way}", lambda config, part=part: filter_features(part, config), configs)


def row(name: str, filtered: Callable[[StereoConfig], Run], configs: Sequence[StereoConfig]) -> list:
    """Errors of the path after rigid alignment, and after similarity alignment."""
    found = [scores(filtered(config)) for config in configs]
    median = {key: float(np.median([one[key] for one in found])) for key in found[0]}
    ours = [one["ate_rmse_m"] for one in found]
    rigid = [median["vo_ate_rmse_m"], median["ate_rmse_m"], min(ours), max(ours)]
    return [name, *rigid, median["vo_ate_sim3_rmse_m"], median["ate_sim3_rmse_m"]]


def scores(run: Run) -> dict[str, float]:
    """Errors of the filter, and, prefixed by `vo_`, those of its odometry alone.

    Raises:
        InputError: the recording has no ground truth.
    """
    log, truth = run.log, run.truth
    if truth is None:
        raise InputError(f"{run.name} has no ground truth, or too little")
    reference = in_space(log.stamps_ns[truth.rows], truth.poses)
    paths = {"": log.poses, "vo_": log["odometry"]}
    entries: dict[str, float] = {}
    for prefix, poses in paths.items():
        entries |= score_path(in_space(log.stamps_ns, poses), reference, truth, prefix)
    return entries


def picture(rows: list[list]):
    """Plots odometry and filter side by side, on a logarithmic scale."""
    figure, axes = new_axes("what the map brings", "position error [m]", "")
    places = range(len(rows))
    for shift, at, name in ((-0.2, 1, "odometry"), (0.2, 2, "filter")):
        errors = [found[at] for found in rows]
        axes.bar([place + shift for place in places], errors, 0.38, color=COLOURS[name], label=name)
    axes.set_yscale("log")
    axes.set_xticks(list(places), [found[0] for found in rows], rotation=20, ha="right")
    axes.legend()
    return figure


if __name__ == "__main__":
    tyro.cli(main)
