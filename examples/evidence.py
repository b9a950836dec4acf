"""Which model explains the recording? Compare log-evidences.

The same recording of position fixes is filtered under three assumptions about their noise. The filter's
evidence p(z_1:T) is an unbiased estimate here, so that its logarithm may be compared; its spread from seed
to seed tells how large a difference means something. For a system of the project, `rbpf compare RUN_A RUN_B` and
`rbpf.validation.consistency.model_comparison.compare_evidence` do the same, and refuse a likelihood that is not a density.
"""

import numpy as np
from gps_fix import STD_FIX, PositionReceiver, simulate

from rbpf import SE2, Filter
from rbpf.motion.odometry import OdometryMotion
from rbpf.validation.consistency.model_comparison import evidence_difference

SEEDS = 5


def log_evidence(recording: list, std: float, seed: int) -> float:
    """Of the recording, if the fixes have this standard deviation [m]."""
    start = np.array([2.0, 0.0, 0.0])
    rng = np.random.default_rng(seed)
    filter_ = Filter(OdometryMotion(SE2), PositionReceiver(std), n=200, rng=rng, start=start)
    for _, control, fix in recording:
        filter_.step(fix, control)
    return filter_.log_evidence


def main() -> dict[float, float]:
    """Prints the log-evidence of three noise levels, and its spread over the seeds."""
    recording = simulate(np.random.default_rng(1))
    figures, logs = {}, {}
    for std in (0.5 * STD_FIX, STD_FIX, 2.0 * STD_FIX):
        values = [log_evidence(recording, std, seed) for seed in range(SEEDS)]
        figures[std], logs[std] = float(np.mean(values)), values
        print(f"fixes good to {std:.2f} m: log-evidence {figures[std]:6.1f} ± {np.std(values):.1f}")
    best = max(figures, key=figures.__getitem__)
    print(f"best: {best:.2f} m; the fixes were simulated with {STD_FIX:.2f} m")
    for std in figures:
        if std != best:
            found = evidence_difference(logs[best], logs[std])
            print(found.sentence(f"noise of {best:.2f} m", f"noise of {std:.2f} m"))
    return figures


if __name__ == "__main__":
    main()
