"""Stop a filter, save it, and continue in another one: the results are the same bytes.

A checkpoint is one `.npz` file of plain arrays with a digest. It holds the particles, the map, the history, the
state of the random generator and any arrays that the caller adds; not the models, which are code.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from custom_sensor import LampSensor, simulate

from rbpf import SE2, Filter, InputError, LandmarkMap, Point
from rbpf.motion.odometry import OdometryMotion
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor


def build(particles: int = 50) -> Filter:
    """The filter; a checkpoint is read by a filter built in the same way."""
    lamp_map = LandmarkMap(SE2)
    lamp_map.register(Point(2))  # so that an empty map knows the checkpoint's landmark type
    sensor = NamedLandmarkSensor(LampSensor(), Point(2))
    return Filter(OdometryMotion(SE2), sensor, lamp_map, n=particles, rng=np.random.default_rng(0))


def main() -> dict[str, bool]:
    """Runs without and with a stop halfway; prints whether both end in the same state."""
    frames, _, _ = simulate(np.random.default_rng(3), steps=80)
    through = build()
    for frame in frames:
        through.step(frame, frame.control)

    with TemporaryDirectory() as folder:
        path = Path(folder) / "half-way.npz"
        first = build()
        for frame in frames[:40]:
            first.step(frame, frame.control)
        first.save(path, {"done": np.array(40)})

        second = build()
        done = int(second.load(path)["done"])
        for frame in frames[done:]:
            second.step(frame, frame.control)

        same = bool(np.array_equal(through.particles.state, second.particles.state))
        print(f"after {second.steps} steps, {done} of them before the stop: same bytes: {same}")
        try:
            build(particles=60).load(path)
        except InputError as error:
            refusal = str(error).replace(str(path), path.name)
            print(f"another filter: {refusal}")
    return {"same": same, "refused": "particles" in refusal}


if __name__ == "__main__":
    main()
