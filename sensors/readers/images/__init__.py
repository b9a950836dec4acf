"""Readers of image sequences: TUM RGB-D, EuRoC ASL, KITTI odometry, 7-Scenes, folders, photos, videos, ROS bags."""

from rbpf.sensors.readers.images.known_points import KnownPixels, read_known_points
from rbpf.sensors.readers.images.opening import open_images
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence
from rbpf.sensors.readers.images.stereo import StereoSequence, open_stereo
from rbpf.sensors.readers.images.topics import Topics

__all__ = [
    "ImageFrame",
    "ImageSequence",
    "KnownPixels",
    "StereoSequence",
    "Topics",
    "open_images",
    "open_stereo",
    "read_known_points",
]
