"""Is the filter any good? Compare a run with the batch optimum of exactly the same measurements.

A simulated robot log is filtered with FastSLAM 2.0; GTSAM then solves for all poses and landmarks at once.
What lies between the two is the price of sampling and of working online; what lies between GTSAM and the
truth is noise.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rbpf.sensors.readers.measurements import dead_reckoning
from rbpf.systems.map_estimate import estimate_map
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.validation.gtsam.robot import solve
from rbpf.validation.metrics.scores import score
from rbpf.validation.range_bearing import start_run
from rbpf.validation.run_folder import used_measurements
from rbpf.validation.simulation.robot import RobotWorld, simulate_robot


def main() -> dict[str, float]:
    """Prints errors of odometry, filter and batch, and whether the filter's covariances are honest."""
    with TemporaryDirectory() as folder:
        simulate_robot(RobotWorld(steps=120, landmarks=40), Path(folder), seed=0)
        run = start_run(Path(folder), RangeBearingConfig(particles=100))
    measurements = used_measurements(run)
    batch = solve(measurements)
    summary = estimate_map(run.filter, run.anchored)
    names = summary.ids.tolist()

    estimates = {
        "odometry alone": (dead_reckoning(measurements), None),
        "filter": (run.progress.mean, dict(zip(names, summary.mean, strict=True))),
        "batch optimum": (batch.world_from_robot, batch.landmarks),
    }
    figures = {}
    for name, (path, landmarks) in estimates.items():
        scores = score(run.log, path, landmarks)
        figures[name] = scores.path_rmse_m
        of_map = "" if landmarks is None else f", landmarks {scores.landmark_error_mean_m:.3f} m"
        print(f"{name:>14}: path {scores.path_rmse_m:.3f} m{of_map}")

    difference = summary.mean - np.array([batch.landmarks[name] for name in names])
    figures["from_batch"] = float(np.linalg.norm(difference, axis=1).mean())
    print(f"the filter's landmarks are {figures['from_batch']:.3f} m from the optimum's")
    spread = [
        np.trace(cov) / np.trace(batch.cov_landmarks[name])
        for name, cov in zip(names, summary.cov, strict=True)
    ]
    figures["sigma_ratio"] = float(np.sqrt(np.median(spread)))
    print(f"and their standard deviations {figures['sigma_ratio']:.2f} times the optimum's (1 is honest)")
    return figures


if __name__ == "__main__":
    main()
