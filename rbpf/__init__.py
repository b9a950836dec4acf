"""Rao-Blackwellised particle filters: bring a motion model and an observation model, get FastSLAM-2.0 inference.

The public names are imported when they are first used, so that `import rbpf` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rbpf.conformance import check_model as check_model
    from rbpf.core.anchoring import StartAnchor as StartAnchor
    from rbpf.core.filter import Filter as Filter
    from rbpf.core.filter import StepReport as StepReport
    from rbpf.core.likelihoods import Gaussian as Gaussian
    from rbpf.core.likelihoods import GaussianWithOutliers as GaussianWithOutliers
    from rbpf.core.likelihoods import TruncatedMahalanobis as TruncatedMahalanobis
    from rbpf.core.marginals import KalmanSubstate as KalmanSubstate
    from rbpf.core.models import NEW as NEW
    from rbpf.core.models import NULL as NULL
    from rbpf.core.models import Conditional as Conditional
    from rbpf.core.models import FusedKernel as FusedKernel
    from rbpf.core.models import Jacobians as Jacobians
    from rbpf.core.models import Landmark as Landmark
    from rbpf.core.models import Likelihood as Likelihood
    from rbpf.core.models import MotionModel as MotionModel
    from rbpf.core.models import NewLandmarks as NewLandmarks
    from rbpf.core.models import ObservationModel as ObservationModel
    from rbpf.core.models import Observations as Observations
    from rbpf.core.models import Part as Part
    from rbpf.core.models import Proposal as Proposal
    from rbpf.core.models import Records as Records
    from rbpf.core.models import Resampler as Resampler
    from rbpf.core.models import Sensor as Sensor
    from rbpf.core.models import Transition as Transition
    from rbpf.core.proposals import EkfProposal as EkfProposal
    from rbpf.core.proposals import PriorProposal as PriorProposal
    from rbpf.core.resampling import EssTriggered as EssTriggered
    from rbpf.core.resampling import Multinomial as Multinomial
    from rbpf.core.resampling import Residual as Residual
    from rbpf.core.resampling import Stratified as Stratified
    from rbpf.core.resampling import Systematic as Systematic
    from rbpf.core.smoothing import ancestral_smoothing as ancestral_smoothing
    from rbpf.core.smoothing import backward_simulation as backward_simulation
    from rbpf.errors import InputError as InputError
    from rbpf.kernels.signature import observation_kernel as observation_kernel
    from rbpf.lie import SE2 as SE2
    from rbpf.lie import SE3 as SE3
    from rbpf.lie import Euclidean as Euclidean
    from rbpf.lie import Product as Product
    from rbpf.maps.landmark_map import LandmarkMap as LandmarkMap
    from rbpf.maps.point import AnchoredPoint as AnchoredPoint
    from rbpf.maps.point import MixturePoint as MixturePoint
    from rbpf.maps.point import Point as Point
    from rbpf.maps.point import ring as ring
    from rbpf.motion.odometry import Odometry as Odometry
    from rbpf.motion.odometry import OdometryMotion as OdometryMotion
    from rbpf.sensors.landmark_sensor import AnonymousLandmarkSensor as AnonymousLandmarkSensor
    from rbpf.sensors.landmark_sensor import NamedLandmarkSensor as NamedLandmarkSensor
    from rbpf.sensors.range_bearing import RangeBearing as RangeBearing
    from rbpf.sensors.range_bearing import RelativePosition as RelativePosition
    from rbpf.sensors.readers import open_log as open_log

__version__ = "0.2.0.dev0"

_HOMES = {
    "core.smoothing": ["ancestral_smoothing", "backward_simulation"],
    "core.anchoring": ["StartAnchor"],
    "sensors.readers": ["open_log"],
    "sensors.range_bearing": ["RangeBearing", "RelativePosition"],
    "sensors.landmark_sensor": ["NamedLandmarkSensor", "AnonymousLandmarkSensor"],
    "motion.odometry": ["Odometry", "OdometryMotion"],
    "kernels.signature": ["observation_kernel"],
    "conformance": ["check_model"],
    "errors": ["InputError"],
    "core.filter": ["Filter", "StepReport"],
    "lie": ["SE2", "SE3", "Euclidean", "Product"],
    "core.likelihoods": ["Gaussian", "GaussianWithOutliers", "TruncatedMahalanobis"],
    "maps.landmark_map": ["LandmarkMap"],
    "maps.point": ["AnchoredPoint", "MixturePoint", "Point", "ring"],
    "core.models": [
        "FusedKernel",
        "NEW",
        "NULL",
        "NewLandmarks",
        "Conditional",
        "Jacobians",
        "Landmark",
        "Likelihood",
        "MotionModel",
        "ObservationModel",
        "Observations",
        "Part",
        "Proposal",
        "Records",
        "Resampler",
        "Sensor",
        "Transition",
    ],
    "core.proposals": ["EkfProposal", "PriorProposal"],
    "core.resampling": ["EssTriggered", "Multinomial", "Residual", "Stratified", "Systematic"],
    "core.marginals": ["KalmanSubstate"],
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = ["__version__", *_HOME_OF]


def __getattr__(name: str) -> Any:
    """Imports a public name on first use."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'rbpf' has no attribute {name!r}")
    value = getattr(import_module(f"rbpf.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
