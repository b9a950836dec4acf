"""Readers of recordings: robot logs, laser scanners, image sequences of one camera or two, known points.

Missing files, and files that differ from the description in a format's module, raise an InputError that names file and line
in one sentence, whichever function here reads them.
"""

from rbpf.sensors.feature_log import Truth
from rbpf.sensors.readers.formats import open_images, open_log, open_stereo
from rbpf.sensors.readers.images.sequence import ImageFrame, ImageSequence, Topics
from rbpf.sensors.readers.known_points import KnownPixels, read_known_points
from rbpf.sensors.readers.laser import LaserOptions, read_laser_log
from rbpf.sensors.readers.part import Part
from rbpf.sensors.readers.robot_log import Frame, LogNoise, RobotLog

__all__ = [
    "Frame",
    "ImageFrame",
    "ImageSequence",
    "KnownPixels",
    "LaserOptions",
    "LogNoise",
    "Part",
    "RobotLog",
    "Topics",
    "Truth",
    "open_images",
    "open_log",
    "open_stereo",
    "read_known_points",
    "read_laser_log",
]
