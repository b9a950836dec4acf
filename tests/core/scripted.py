"""Filters that are handed their observations directly, and steps that must fail."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.filter import Filter
from rbpf.models import ObservationModel, Observations, Sensor
from tests.core.worlds import content, same


class Scripted(Sensor):
    """Frames are the groups of observations."""

    def observe(self, frame, belief):
        return frame


def seen(model: ObservationModel, z, cov=None, **options) -> list[Observations]:
    """One group; its covariances are identities unless told."""
    z = np.array(z, dtype=float)
    cov = (
        np.broadcast_to(np.eye(z.shape[-1]), (*z.shape, z.shape[-1])) if cov is None else np.array(cov, float)
    )
    return [Observations(z, cov, model, **options)]


def fails(filter_: Filter, match: str, *step: object) -> None:
    """A step raises one sentence, and nothing has changed."""
    before, generator = content(filter_), filter_.rng.bit_generator.state
    with pytest.raises(InputError, match=match) as caught:
        filter_.step(*step)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert same(content(filter_), before)
    assert filter_.rng.bit_generator.state == generator
