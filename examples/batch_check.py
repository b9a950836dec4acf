"""Is the filter any good? Compare a run with the batch optimum of exactly the same measurements.

A simulated robot log is filtered with FastSLAM 2.0; GTSAM then solves for all poses and landmarks at once.
What lies between the two is the price of sampling and of working online; what lies between GTSAM and the
truth is noise.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rbpf.runs.reading import PathAndMap
from rbpf.runs.recordings import RobotRecording, filter_recording
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.gtsam.robot import solve
from rbpf.validation.metrics.scores import score_estimate
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


def main() -> dict[str, float]:
    """Prints errors of odometry, filter and batch, and whether the filter's covariances are honest."""
    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(steps=120, landmarks=40), Path(folder), seed=0)
        run = filter_recording(RobotRecording(Path(folder)), RangeBearingConfig(particles=100))
    batch = solve(run.system.measurements(run.name, run.log))
    summary = run.system.map()
    names = summary.ids.tolist()
    points = np.array([batch.landmarks[name] for name in names])

    nothing = replace(summary, ids=summary.ids[:0])
    estimates = {
        "odometry alone": (run.log["odometry"], nothing),
        "filter": (run.log.poses, summary),
        "batch optimum": (batch.world_from_robot, replace(summary, mean=points)),
    }
    figures = {}
    for name, (path, landmarks) in estimates.items():
        scores = score_estimate(PathAndMap(run.log.stamps_ns, path, run.log.covs, landmarks), run.truth)
        figures[name] = scores["path_rmse_m"]
        error = scores.get("landmark_error_mean_m")
        of_map = "" if error is None else f", landmarks {error:.3f} m"
        print(f"{name:>14}: path {figures[name]:.3f} m{of_map}")

    difference = summary.mean - points
    figures["from_batch"] = float(np.linalg.norm(difference, axis=1).mean())
    print(f"the filter's landmarks are {figures['from_batch']:.3f} m from the optimum's")
    spread = [np.trace(cov) / np.trace(batch.cov_landmarks[name]) for name, cov in zip(names, summary.cov, strict=True)]
    figures["sigma_ratio"] = float(np.sqrt(np.median(spread)))
    print(f"and their standard deviations {figures['sigma_ratio']:.2f} times the optimum's (1 is honest)")
    return figures


if __name__ == "__main__":
    main()
