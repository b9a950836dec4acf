"""Range-bearing and position sensors."""

from rbpf.sensors.range_bearing.models import RangeBearing, RelativePosition, RigidPointModel, wrap_angle

__all__ = ["RangeBearing", "RelativePosition", "RigidPointModel", "wrap_angle"]
