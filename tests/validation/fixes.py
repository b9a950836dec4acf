"""A walk in the plane and fixes of it: a linear-Gaussian model of one's own."""

import numpy as np

from rbpf.core.models import MotionModel, ObservationModel, Observations, Part, Sensor, Transition
from rbpf.lie import Euclidean


class Walk(MotionModel):
    """A random walk, by default of 1 m per step."""

    space = Euclidean(2)

    def __init__(self, variance=1.0):
        self.variance = variance

    def transition(self, state, control, dt):
        return Transition(state, self.variance * np.eye(2)[None])


class Position(ObservationModel):
    """A position fix."""

    dim, reads = 2, frozenset({Part.STATE})

    def predict(self, state, landmark=None, const=None, substate=None):
        return state


class Receiver(Sensor):
    """Fixes with a claimed standard deviation."""

    def __init__(self, std):
        self.std = std

    def observe(self, frame, belief):
        return [Observations(frame[None], self.std**2 * np.eye(2)[None], Position())]
