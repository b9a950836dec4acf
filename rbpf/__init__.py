"""Rao-Blackwellised particle filters: bring a motion model and an observation model, get FastSLAM-2.0 inference.

The public names are imported when they are first used, so that `import rbpf` is quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rbpf.anchoring import StartAnchor as StartAnchor
    from rbpf.conformance import check_model as check_model
    from rbpf.errors import InputError as InputError
    from rbpf.filter import Filter as Filter
    from rbpf.filter import StepReport as StepReport
    from rbpf.kernels.signature import observation_kernel as observation_kernel
    from rbpf.lie import SE2 as SE2
    from rbpf.lie import SE3 as SE3
    from rbpf.lie import Euclidean as Euclidean
    from rbpf.lie import Product as Product
    from rbpf.likelihoods import Gaussian as Gaussian
    from rbpf.likelihoods import GaussianWithOutliers as GaussianWithOutliers
    from rbpf.likelihoods import TruncatedMahalanobis as TruncatedMahalanobis
    from rbpf.maps.landmark_map import LandmarkMap as LandmarkMap
    from rbpf.maps.mixture import MixturePoint as MixturePoint
    from rbpf.maps.mixture import ring as ring
    from rbpf.maps.point import AnchoredPoint as AnchoredPoint
    from rbpf.maps.point import Point as Point
    from rbpf.models import NEW as NEW
    from rbpf.models import NULL as NULL
    from rbpf.models import Conditional as Conditional
    from rbpf.models import FusedKernel as FusedKernel
    from rbpf.models import Jacobians as Jacobians
    from rbpf.models import Landmark as Landmark
    from rbpf.models import Likelihood as Likelihood
    from rbpf.models import MotionModel as MotionModel
    from rbpf.models import NewLandmarks as NewLandmarks
    from rbpf.models import ObservationModel as ObservationModel
    from rbpf.models import Observations as Observations
    from rbpf.models import Part as Part
    from rbpf.models import Proposal as Proposal
    from rbpf.models import Records as Records
    from rbpf.models import Resampler as Resampler
    from rbpf.models import Sensor as Sensor
    from rbpf.models import Transition as Transition
    from rbpf.motion.odometry import Odometry as Odometry
    from rbpf.motion.odometry import OdometryMotion as OdometryMotion
    from rbpf.proposals import EkfProposal as EkfProposal
    from rbpf.proposals import PriorProposal as PriorProposal
    from rbpf.resampling import EssTriggered as EssTriggered
    from rbpf.resampling import Multinomial as Multinomial
    from rbpf.resampling import Residual as Residual
    from rbpf.resampling import Stratified as Stratified
    from rbpf.resampling import Systematic as Systematic
    from rbpf.sensors.landmark_sensor import AnonymousLandmarkSensor as AnonymousLandmarkSensor
    from rbpf.sensors.landmark_sensor import NamedLandmarkSensor as NamedLandmarkSensor
    from rbpf.sensors.range_bearing import RangeBearing as RangeBearing
    from rbpf.sensors.range_bearing import RelativePosition as RelativePosition
    from rbpf.sensors.readers import open_log as open_log
    from rbpf.smoothing import ancestral_smoothing as ancestral_smoothing
    from rbpf.smoothing import backward_simulation as backward_simulation
    from rbpf.substate import KalmanSubstate as KalmanSubstate

__version__ = "0.1.0"

_HOMES = {
    "smoothing": ["ancestral_smoothing", "backward_simulation"],
    "anchoring": ["StartAnchor"],
    "sensors.readers": ["open_log"],
    "sensors.range_bearing": ["RangeBearing", "RelativePosition"],
    "sensors.landmark_sensor": ["NamedLandmarkSensor", "AnonymousLandmarkSensor"],
    "motion.odometry": ["Odometry", "OdometryMotion"],
    "kernels.signature": ["observation_kernel"],
    "conformance": ["check_model"],
    "errors": ["InputError"],
    "filter": ["Filter", "StepReport"],
    "lie": ["SE2", "SE3", "Euclidean", "Product"],
    "likelihoods": ["Gaussian", "GaussianWithOutliers", "TruncatedMahalanobis"],
    "maps.landmark_map": ["LandmarkMap"],
    "maps.mixture": ["ring", "MixturePoint"],
    "maps.point": ["AnchoredPoint", "Point"],
    "models": [
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
    "proposals": ["EkfProposal", "PriorProposal"],
    "resampling": ["EssTriggered", "Multinomial", "Residual", "Stratified", "Systematic"],
    "substate": ["KalmanSubstate"],
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
