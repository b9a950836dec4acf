"""Curves over the frames of a run over images: error, what was found, times."""

from typing import Any

import numpy as np

from rbpf.lie import SE3
from rbpf.runs.alignment import Alignment
from rbpf.runs.plots import COLOURS, SIGMAS, stacked_axes
from rbpf.runs.trajectory import Trajectory
from rbpf.systems.mono.video import VideoRun
from rbpf.validation.gtsam.mono_batch import Batch
from rbpf.validation.metrics.accuracy import ate
from rbpf.validation.metrics.mono_scores import TruePath, usual_alignment

CAMERA_HZ = 30.0


def error_figure(run: VideoRun, truth: TruePath, batch: Batch | None = None) -> Any:
    """Error of the position along the truth's axes, beside what the filter itself believes (3σ), and the batch's.

    With known points nothing is aligned; else each path is first brought onto the truth, and its 3σ with it.
    """
    poses, stamps = run.world_from_camera[truth.rows], run.stamps_ns[truth.rows]
    estimate, reference = Trajectory(stamps, poses), Trajectory(stamps, truth.world_from_camera)
    how = usual_alignment(run)
    moved = ate(estimate, reference, how).alignment
    error = moved.transform(estimate.positions) - reference.positions
    turn = moved.scale * moved.rotation @ SE3.matrix(poses)[:, :3, :3]
    cov = turn @ run.cov[truth.rows][:, 3:, 3:] @ np.swapaxes(turn, -1, -2)
    band = SIGMAS * np.sqrt(np.maximum(np.einsum("taa->ta", cov), 0.0))
    name = "no alignment" if how == "none" else f"after the {how} alignment"
    figure, rows = stacked_axes(3, f"{run.sequence.name}: error of the position, {name}")
    if batch is not None:
        _batch_error(rows, truth, batch, how)
    for axis, axes in enumerate(rows):
        axes.fill_between(
            truth.rows, -1e3 * band[:, axis], 1e3 * band[:, axis], color=COLOURS["filter"], alpha=0.2, lw=0,
            label=f"{SIGMAS:g}σ of the filter",
        )  # fmt: skip
        axes.plot(
            truth.rows, 1e3 * error[:, axis], color=COLOURS["filter"], lw=1.0, label="error of the filter"
        )
        axes.axhline(0.0, color="black", lw=0.5)
        axes.set_ylabel(f"{'xyz'[axis]} [mm]")
        _shade_lost(axes, run)
    rows[0].legend(loc="best", fontsize="small")
    rows[-1].set_xlabel("frame")
    return figure


def _batch_error(rows: list[Any], truth: TruePath, batch: Batch, how: Alignment) -> None:
    frames, ours, theirs = np.intersect1d(batch.frames, truth.rows, return_indices=True)
    stamps = batch.trajectory.stamps_ns[ours]
    reference = Trajectory(stamps, truth.world_from_camera[theirs])
    estimate = Trajectory(stamps, batch.world_from_camera[ours])
    moved = ate(estimate, reference, how).alignment.transform(estimate.positions)
    for axes, error in zip(rows, 1e3 * (moved - reference.positions).T, strict=True):
        axes.plot(frames, error, color=COLOURS["batch"], lw=1.0, label="error of the batch")


def tracking_figure(run: VideoRun) -> Any:
    """Landmarks looked for and found, effective sample size, innovations."""
    figure, (upper, middle, lower) = stacked_axes(3, f"{run.sequence.name}: search and filter")
    frames = np.arange(run.found.size)
    upper.plot(frames, run.searched, color="0.6", lw=1.0, label="looked for")
    upper.plot(frames, run.found, color=COLOURS["known"], lw=1.0, label="found")
    upper.set(ylabel="landmarks", ylim=(0, None))
    middle.plot(frames, run.ess, color=COLOURS["filter"], lw=0.8, label="effective sample size")
    limit = run.config.resampling.ess_threshold * run.config.particles
    middle.axhline(limit, color=COLOURS["map"], lw=0.8, ls="--", label="resampling below")
    middle.set(ylabel="particles", ylim=(0, None))
    seen = (run.nis_dof > 0) & np.isfinite(run.nis) & (run.nis > 0)
    ratio = run.nis[seen] / run.nis_dof[seen]
    lower.plot(frames[seen], ratio, ".", ms=3, color=COLOURS["filter"], label="NIS / degrees of freedom")
    lower.axhline(1.0, color="black", lw=0.8, label="honest filter's mean")
    lower.set(xlabel="frame", ylabel="ratio", yscale="log")
    for axes in (upper, middle, lower):
        _shade_lost(axes, run)
        axes.legend(loc="best", fontsize="small")
    return figure


def timings_figure(run: VideoRun) -> Any:
    """Time per frame by stage; decoding apart."""
    figure, (axes,) = stacked_axes(1, f"{run.sequence.name}: time per frame")
    frames = np.arange(run.seconds.size)
    search, new_landmarks = 1e3 * run.seconds_search, 1e3 * run.seconds_new_landmarks
    rest = 1e3 * run.seconds - search - new_landmarks
    names = ["search in the image", "filter", "new features"]
    axes.stackplot(frames, search, rest, new_landmarks, labels=names, alpha=0.7, lw=0)
    axes.plot(frames, 1e3 * run.seconds_waiting, color="black", lw=0.6, label="waiting for the decoded image")
    axes.axhline(1e3 / CAMERA_HZ, color=COLOURS["map"], lw=0.8, ls="--", label=f"{CAMERA_HZ:g} Hz")
    high = max(
        1e3 / CAMERA_HZ, 2.5 * float(np.median(1e3 * run.seconds))
    )  # frames that compile run out of the picture
    axes.set(xlabel="frame", ylabel="ms", ylim=(0.0, 1.3 * high))
    axes.legend(loc="best", fontsize="small")
    return figure


def _shade_lost(axes: Any, run: VideoRun) -> None:
    lost = np.flatnonzero(run.lost)
    for number, group in enumerate(
        np.split(lost, np.flatnonzero(np.diff(lost) > 1) + 1) if lost.size else []
    ):
        name = "lost" if number == 0 else None
        axes.axvspan(group[0] - 0.5, group[-1] + 0.5, color=COLOURS["map"], alpha=0.2, lw=0, label=name)
