"""Grid SLAM with a laser scanner, by the method of GMapping.

G. Grisetti, C. Stachniss, W. Burgard, "Improved techniques for grid mapping with Rao-Blackwellized particle filters", 2007.

    slam = LaserSlam(log.scanner)
    for scan in log.frames:
        frame = slam.track(scan.ranges, scan.odometry, scan.stamp_ns)

Each particle searches its own grid for the pose that explains the scan best, and is sampled from the Gaussian about it; the
filter then corrects by the exact ratio w₂ = p(z|x) p(x|x⁻) / (q(x) w₁). A scan is used once the robot has moved since the
last one used; the poses of the others follow from the odometry.
"""

from typing import Any, ClassVar, final

import numpy as np

from rbpf.core.checkpoint import Kept, elements, integers, numbers
from rbpf.core.models import LineariseAt, Proposal
from rbpf.core.particles import Prior, Proposed
from rbpf.core.proposals import PriorProposal
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.grid import GRID, GridMap, Picture
from rbpf.motion.odometry import Odometry, OdometryMotion
from rbpf.sensors.laser import BeamSensor, Scan, Scanner
from rbpf.systems.laser.config import LaserConfig
from rbpf.systems.map_estimate import MapEstimate
from rbpf.systems.system import DIAGNOSTICS, FILTER_COLUMNS, Column, FrameLog, System, Tracked, TrackingState

BARELY = 0.1  #: Fit (0 to 1) below which a scan does not localise the robot.


@final
class ScanMatching(Proposal):
    """The Gaussian about the best match of a scan's beams (K, 5) in each particle's grid, see `GridMap.match`."""

    def __init__(self, grid: GridMap, beams: np.ndarray) -> None:
        self.grid, self.beams = grid, beams
        self.fit = 0.0  #: Fit of the scan (0 to 1), a mean over the particles.

    def propose(self, prior: Prior, linearise: LineariseAt, rng: np.random.Generator) -> Proposed:
        proposed, fit = self.grid.match(prior, self.beams)
        self.fit = float(fit.mean())
        return proposed


@final
class LaserSlam(Kept, System):
    """Grid SLAM.

    Args:
        scanner: directions of its beams, and mounting pose.
        config: all settings.
    """

    name = "laser"
    frame_word = "scan"
    space = SE2
    config: LaserConfig
    kept: ClassVar = {
        "_pose": elements(SE2),
        "_cov": numbers(3, 3),
        "_since": elements(SE2),
        "_moved": numbers(3, least=0),
        "_odometry": elements(SE2),
        "_measured": numbers(3, values="any"),
        "_twist": numbers(3),
        "_stamp_ns": integers(),
        "_ess": numbers(),
    }
    prefix = "laser/"

    def __init__(self, scanner: Scanner, config: LaserConfig | None = None) -> None:
        self.scanner, self.config = scanner, (config := config or LaserConfig())
        self.grid = GridMap(config.grid)
        self.filter = self.new_filter(OdometryMotion(SE2), BeamSensor(GRID), [self.grid])
        self.columns = (
            *FILTER_COLUMNS,
            Column("fit", "how well the scan fits the map, of 1; NaN where it was not matched", table=DIAGNOSTICS),
            Column("beams", "readings that came back", kind=int, table=DIAGNOSTICS),
            Column("odometry", "world_from_robot by odometry alone", shape=(3,)),
        )
        # The last step's pose, and since then: motion by odometry, distance, rotation, time without odometry.
        self._pose, self._cov = SE2.identity(), np.zeros((3, 3))
        self._since, self._moved = SE2.identity(), np.zeros(3)
        # Composed odometry, its last reading (NaN without one), the velocity between the last two steps.
        self._odometry, self._measured = SE2.identity(), np.full(3, np.nan)
        self._twist = np.zeros(3)
        self._stamp_ns = -1  # of the last scan, −1 before the first
        self._ess = float(config.particles)  # of the last step

    def track(self, ranges: np.ndarray, odometry: np.ndarray | None = None, stamp_ns: int | None = None) -> Tracked:
        """Processes a scan.

        Args:
            ranges: (B,) [m]; inf for no return, NaN for an invalid reading.
            odometry: (E,) world_from_robot by odometry; None without one: constant velocity is assumed.
            stamp_ns: time; by default a second after the last scan.

        Raises InputError: time runs backwards, the numbers of readings and beams differ, or the map outgrows the memory.
        """
        previous, last_ns = self._stamp_ns, self.filter.stamp_ns
        stamp_ns = self.checked_stamp(previous + 1_000_000_000 if stamp_ns is None else stamp_ns, previous)
        beams, messages = self.scanner.beams(ranges, self.config.correlation_m), list[str]()
        self._move(odometry, (stamp_ns - previous) * 1e-9 if previous >= 0 else 0.0, messages)
        self._stamp_ns = stamp_ns

        # Use the scan if it has enough returns and the robot has moved.
        state, fit, resampled = TrackingState.PREDICTED, float("nan"), False
        way, turned, without = self._moved.tolist()
        far = way >= self.config.distance_m or turned >= self.config.angle_rad
        if len(beams) < self.config.least_beams:
            messages.append(f"{len(beams)} of {len(ranges)} readings came back: the pose is predicted")
        elif last_ns is None or far or without > 0.0 or (stamp_ns - last_ns) * 1e-9 >= self.config.seconds:
            proposal = None if last_ns is None else ScanMatching(self.grid, beams)
            resampled, state = self._step(beams, stamp_ns, proposal), TrackingState.TRACKED
            if proposal is not None:
                fit = proposal.fit
            if fit < BARELY:
                state = TrackingState.LOST
                messages.append(f"the scan hardly fits the map ({100 * fit:.0f} %): the robot is not localised")
        # Between two steps the pose is the last one moved by the odometry.
        now = Odometry(self._pose, self._cov).then(self._motion_since_step(), SE2)
        nothing = {"log_evidence": float("nan"), "nis": float("nan"), "nis_dof": 0.0}
        own = {"fit": fit, "beams": len(beams), "odometry": self._odometry}
        values = {"ess": self._ess, "resampled": resampled, **nothing, **own}
        return Tracked(stamp_ns, now.delta, now.cov, state, values, messages=tuple(messages))

    def take(self, frame: Scan) -> Tracked:
        return self.track(frame.ranges, frame.odometry, frame.stamp_ns)

    def map(self) -> MapEstimate:
        """No landmarks; the grid is `picture`."""
        return MapEstimate(np.zeros(0, dtype=np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)))

    def picture(self) -> Picture:
        """The grid of the particle of highest weight."""
        return self.grid.picture(int(np.argmax(self.filter.particles.log_weights)))

    def measurements(self, name: str, log: FrameLog) -> None:
        """None, as scans are not measurements of landmarks."""

    def particle_poses(self) -> np.ndarray:
        return SE2.compose(self.filter.particles.state, self._since)

    def summary(self, log: FrameLog) -> dict[str, Any]:
        picture, fits = self.picture(), log["fit"][np.isfinite(log["fit"])]
        return {
            "scans_used": self.filter.steps,
            "fit_mean": float(fits.mean()) if fits.size else None,
            "map_known_m2": round(float((picture.log_odds != 0.0).sum()) * picture.cell_m**2, 2),
            "map_tiles": self.grid.tiles,
            "map_share_of_dense": round(self.grid.tiles / max(1, int((self.grid.index >= 0).sum())), 4),
            "ancestors_of_first_generation": self.filter.history.distinct_first(),
        }

    def files(self, log: FrameLog) -> dict[str, dict[str, np.ndarray]]:
        """The grid; and the particles' paths at all scans since their first stored step, by odometry between steps."""
        picture, history, odometry = self.picture(), self.filter.history, log["odometry"]
        grid = {"log_odds": picture.log_odds, "cell_m": np.array(picture.cell_m), "corner": picture.corner}
        step = np.searchsorted(history.stamps_ns, log.stamps_ns, side="right") - 1
        scans = step >= 0
        if not scans.any():  # no scan had returns
            return {"grid.npz": grid}
        at_step = odometry[np.searchsorted(log.stamps_ns, history.stamps_ns)]
        since = SE2.between(at_step[step[scans]], odometry[scans])
        paths = {
            "stamps_ns": log.stamps_ns[scans],
            "world_from_robot": SE2.compose(history.paths()[step[scans]], since[:, None]),
            "log_weights": self.filter.particles.log_weights,
        }
        return {"posterior.npz": paths, "grid.npz": grid}

    def _move(self, odometry: np.ndarray | None, seconds: float, messages: list[str]) -> None:
        """Adds the motion since the last scan, by odometry, or by the velocity between the last two steps."""
        fastest = self.config.motion.fastest
        now = np.full(3, np.nan) if odometry is None else np.asarray(odometry, dtype=float)
        if now.shape != (3,):
            raise InputError(f"odometry is world_from_robot (3,), an element of SE2, got {now.shape}")
        if odometry is not None and not np.isfinite(now).all():
            messages.append("the odometry is not finite: the motion is assumed to go on as before")
            now = np.full(3, np.nan)
        delta, has_delta = SE2.identity(), False
        if np.isfinite(now).all() and np.isfinite(self._measured).all():
            delta = SE2.between(self._measured, now)
            way, turned = float(np.hypot(delta[1], delta[2])), float(abs(delta[0]))
            has_delta = max(way, turned) <= fastest * max(seconds, 0.1)
            if not has_delta:
                jump = f"{way:.1f} m and {np.degrees(turned):.0f} degrees in {seconds:.2f} s"
                messages.append(f"the odometry jumps by {jump}: the motion is assumed to go on as before")
        if has_delta:
            self._moved += [way, turned, 0.0]
        elif self.filter.steps:  # before the first step the world's origin is at the current scan
            delta = SE2.exp(self._twist * seconds)
            self._moved[2] += seconds
        self._measured = now
        self._since, self._odometry = SE2.compose(self._since, delta), SE2.compose(self._odometry, delta)

    def _motion_since_step(self) -> Odometry:
        """The motion since the last step."""
        way, turned, without = self._moved.tolist()
        if not self._moved.any():
            return Odometry(self._since, np.zeros((3, 3)))
        motion = self.config.motion
        return Odometry(self._since, motion.cov(way, turned) + (motion.cov_without(without) if without else 0.0))

    def _step(self, beams: np.ndarray, stamp_ns: int, proposal: Proposal | None) -> bool:
        """A step of the filter; returns whether it resampled."""
        last_ns, before = self.filter.stamp_ns, self._pose
        moved = None if last_ns is None and not self._moved.any() else self._motion_since_step()
        if proposal is None or not self._moved.any():  # no motion, nothing to match
            proposal = PriorProposal()
        report = self.filter.step(beams, moved, stamp_ns, proposal)
        self._pose, self._cov, self._ess = report.estimate.mean, report.estimate.cov, report.ess
        if last_ns is not None and stamp_ns > last_ns:
            self._twist = SE2.log(SE2.between(before, self._pose)) / ((stamp_ns - last_ns) * 1e-9)
        self._since, self._moved = SE2.identity(), np.zeros(3)
        return report.resampled
