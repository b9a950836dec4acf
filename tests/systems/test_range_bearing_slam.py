"""The robot's system, frame by frame."""

import time

import numpy as np

from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.range_bearing.slam import RangeBearingSlam


def test_many_first_sightings_in_one_frame_take_time_in_proportion_to_their_number():
    """30,000 names, the last one twice: the second time tells nothing in the frame that starts the landmark."""
    count = 30_000
    rng = np.random.default_rng(0)
    z = np.stack([rng.uniform(1.0, 100.0, count), rng.uniform(-3.0, 3.0, count)], axis=1)
    cov_z = np.broadcast_to(np.diag([1e-2, 1e-3]), (count, 2, 2))
    names = np.minimum(np.arange(count), count - 2)
    slam = RangeBearingSlam(RangeBearingConfig(particles=2, map="particles"))
    started = time.process_time()
    used = slam.track(z, cov_z, names).observed["landmarks"]
    assert time.process_time() - started < 2.0  # 0.3 s; 4 s if each is compared with all before it
    assert used.tolist() == [*range(count - 1), -1]
    assert slam.track(z[-2:], cov_z[-2:], names[-2:]).observed["landmarks"].tolist() == [count - 2] * 2
