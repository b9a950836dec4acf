"""Readers of recordings."""

from rbpf.sensors.readers.log import Frame, RobotLog, Truth
from rbpf.sensors.readers.noise import LogNoise
from rbpf.sensors.readers.opening import open_log

__all__ = ["Frame", "LogNoise", "RobotLog", "Truth", "open_log"]
