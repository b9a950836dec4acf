"""Records as columns and back, for every kind of parametrisation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.models import Landmark, Records
from rbpf.errors import InputError
from rbpf.maps.store import Layout


class Free(Landmark):
    """A parametrisation of any size."""

    def __init__(self, dim: int, constants: int = 0, components: int = 1) -> None:
        self.dim, self.constants, self.components = dim, constants, components

    def homogeneous(self, mean, const=None):
        return np.concatenate([mean[..., :2], np.ones((*mean.shape[:-1], 1))], axis=-1)


def random_records(landmark: Landmark, n: int, k: int, rng: np.random.Generator) -> Records:
    inner = (n, k) if landmark.components == 1 else (n, k, landmark.components)
    factor = rng.normal(size=(*inner, landmark.dim, landmark.dim))
    cov = factor @ np.swapaxes(factor, -1, -2)
    return Records(
        rng.normal(size=(*inner, landmark.dim)),
        0.5 * (cov + np.swapaxes(cov, -1, -2)),
        rng.normal(size=(n, k, landmark.constants)) if landmark.constants else None,
        rng.normal(size=inner) if landmark.components > 1 else None,
    )


@given(
    dim=st.integers(1, 6),
    constants=st.integers(0, 7),
    components=st.integers(1, 5),
    n=st.integers(1, 4),
    k=st.integers(0, 3),
    evidence=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_round_trip(dim, constants, components, n, k, evidence, seed):
    rng = np.random.default_rng(seed)
    layout = Layout(Free(dim, constants, components), evidence)
    records, log_odds = random_records(layout.landmark, n, k, rng), rng.normal(size=(n, k))
    columns = layout.pack(records, log_odds if evidence else None)
    assert columns.shape == (k, layout.fields, n)
    assert columns.flags.c_contiguous
    again = layout.unpack(columns)
    for name, expected in vars(records).items():
        found = getattr(again, name)
        assert (found is None) == (expected is None)
        if expected is not None:
            np.testing.assert_array_equal(found, expected)
    if evidence:
        np.testing.assert_array_equal(columns[:, -1].T, log_odds)


def test_constants_may_be_shared_by_all_particles():
    records = random_records(Free(2), 3, 2, np.random.default_rng(0))
    const = np.arange(8.0).reshape(1, 2, 4)
    columns = Layout(Free(2, 4)).pack(Records(records.mean, records.cov, const))
    unpacked = Layout(Free(2, 4)).unpack(columns)
    np.testing.assert_array_equal(np.asarray(unpacked.const), np.repeat(const, 3, axis=0))


GOOD = random_records(Free(2), 3, 2, np.random.default_rng(0))
WEIGHTS = np.zeros((3, 2, 2))


@pytest.mark.parametrize(
    ("landmark", "records", "match"),
    [
        (Free(3), GOOD, r"Free has 1 component\(s\) of dimension 3: expected means \(3, 2, 3\)"),
        (Free(2, components=2), GOOD, r"expected means \(3, 2, 2, 2\)"),
        (Free(2), Records(GOOD.mean, GOOD.cov[:, :1]), r"covariances \(3, 1, 2, 2\)"),
        (Free(2, constants=4), GOOD, "Free has 4 constants per landmark: give them in Records.const"),
        (Free(2), Records(GOOD.mean, GOOD.cov, np.zeros((3, 2, 1))), "Free has 0 constants per landmark"),
        (Free(2), Records(GOOD.mean, GOOD.cov, None, WEIGHTS), "needs log_weights exactly if it has several"),
        (Free(2), Records(GOOD.mean * np.nan, GOOD.cov), "a new Free has a mean or covariance that is not finite"),
        (Free(2), Records(GOOD.mean, GOOD.cov * np.inf), "a new Free has a mean or covariance that is not finite"),
    ],
)
def test_records_that_do_not_fit(landmark, records, match):
    with np.errstate(invalid="ignore"), pytest.raises(InputError, match=match):
        Layout(landmark).pack(records)
