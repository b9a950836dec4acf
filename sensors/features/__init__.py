"""Keypoints and descriptors: the classes to subclass, and those that the systems use."""

from rbpf.sensors.features.corners import CornerDetector
from rbpf.sensors.features.interface import Descriptor, Detector, Extractor, FeatureExtractor, Features, Keypoints
from rbpf.sensors.features.sift import Sift, SiftConfig

__all__ = [
    "CornerDetector",
    "Descriptor",
    "Detector",
    "Extractor",
    "FeatureExtractor",
    "Features",
    "Keypoints",
    "Sift",
    "SiftConfig",
]
