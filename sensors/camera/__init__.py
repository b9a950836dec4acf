"""Cameras: projection, lens distortion, observation models of points seen in images, and camera poses from points."""

from rbpf.sensors.camera.pinhole import LENSES, Pinhole, RectifiedStereo

__all__ = ["LENSES", "Pinhole", "RectifiedStereo"]
