"""Filters that are handed their observations directly, and steps that must fail."""

import numpy as np
import pytest

from rbpf.core.filter import Filter, StepReport
from rbpf.core.models import ObservationModel, Observations, Sensor
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.sensors.range_bearing import wrap_angle
from tests.core.worlds import content, same


class Scripted(Sensor):
    """Frames are the groups of observations."""

    def observe(self, frame, belief):
        return frame


def seen(model: ObservationModel, z, cov=None, **options) -> list[Observations]:
    """One group; its covariances are identities unless told."""
    z = np.array(z, dtype=float)
    cov = np.broadcast_to(np.eye(z.shape[-1]), (*z.shape, z.shape[-1])) if cov is None else np.array(cov, float)
    return [Observations(z, cov, model, **options)]


def ids_of(report: StepReport) -> np.ndarray:
    """Ids of the first group."""
    ids = report.groups[0].ids
    assert ids is not None
    return ids


def fails(filter_: Filter, match: str, *step: object) -> None:
    """A step raises one sentence, and nothing has changed."""
    before, generator = content(filter_), filter_.rng.bit_generator.state
    with pytest.raises(InputError, match=match) as caught:
        filter_.step(*step)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert same(content(filter_), before)
    assert filter_.rng.bit_generator.state == generator


def says(findings: list[str], sentence: str) -> None:
    """The sentence is among the findings."""
    with pytest.raises(AssertionError, match=sentence):
        raise AssertionError("\n".join(findings))


class Polar(ObservationModel):
    """A sound model in plain NumPy: range and bearing in the plane."""

    dim = 2
    space = SE2

    def predict(self, state, landmark=None, const=None, substate=None):
        point = SE2.inverse_transform(state, landmark)
        return np.stack([np.hypot(point[..., 0], point[..., 1]), np.arctan2(point[..., 1], point[..., 0])], axis=-1)

    def residual(self, z, predicted):
        return np.stack([z[..., 0] - predicted[..., 0], wrap_angle(z[..., 1] - predicted[..., 1])], axis=-1)

    def invert(self, state, z):
        point = np.stack([z[..., 0] * np.cos(z[..., 1]), z[..., 0] * np.sin(z[..., 1])], axis=-1)
        return SE2.transform(state, point)
