"""What the store is made of: records as columns and back, and tables of columns that come and go beside a dictionary."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rbpf.core.genealogy import Lineage
from rbpf.core.models import NEW, NULL, Belief, Landmark, ObservationModel, Observations, Part, Records
from rbpf.core.particles import Prior
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.maps.inverse_depth import InverseDepth
from rbpf.maps.landmark_map import LandmarkMap
from rbpf.maps.point import Point
from rbpf.maps.rows import Plan, Row, make_plan
from rbpf.maps.store import Columns, Layout
from rbpf.sensors.camera import Pinhole
from rbpf.sensors.camera.points import CameraPoint, CameraRay, EpipolarRay


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


def filled(columns: Columns, count: int, ids: np.ndarray | None = None) -> list[int]:
    """New columns; everything noted of one follows from its id."""
    added = columns.add(count, ids)
    rows = columns.rows(added)
    columns.fields[rows], columns.generation[rows] = added + 1, 2 * added
    columns.slab[rows], columns.kind[rows] = 3 * added, added % 3
    return added.tolist()


@given(
    st.lists(st.tuples(st.integers(0, 90), st.integers(0, 90), st.integers(0, 2**32 - 1), st.booleans()), max_size=8)
)
def test_as_a_dictionary(edits):
    """Ids that are counted up, and ids of the caller's in any order."""
    columns, model, next_id = Columns(), dict[int, int](), 0
    for new, gone, seed, numbered in edits:
        rng = np.random.default_rng(seed)
        free = np.setdiff1d(np.arange(1000), list(model))
        ids = rng.choice(free, new, replace=False) if numbered else None
        added = filled(columns, new, ids)
        assert added == (list(range(next_id, next_id + new)) if ids is None else ids.tolist())
        next_id = max([next_id, *(column + 1 for column in added)])
        model |= {column: column % 3 for column in added}
        removed = rng.choice(sorted(model), min(gone, len(model)), replace=False).astype(np.int64)
        columns.remove(removed)
        for column in removed.tolist():
            del model[column]
        ids = np.array(list(model), dtype=np.int64)
        np.testing.assert_array_equal(columns.ids, ids)
        assert columns.next_id == next_id
        again = Columns()
        again.add(ids.size, ids)
        np.testing.assert_array_equal(again.rows(ids), columns.rows(ids))
        rows = columns.rows(ids)
        np.testing.assert_array_equal(rows, np.arange(ids.size))
        np.testing.assert_array_equal(columns.fields[rows], ids + 1)
        np.testing.assert_array_equal(columns.generation[rows], 2 * ids)
        np.testing.assert_array_equal(columns.slab[rows], 3 * ids)
        asked = np.arange(-2, next_id + 3)
        np.testing.assert_array_equal(columns.held(asked), [column in model for column in asked.tolist()])
        np.testing.assert_array_equal(columns.kinds(asked), [model.get(column, -1) for column in asked.tolist()])


# Which rows are independent and which belong together.

N = 4
NUMBERS = np.array([0, 0, 0, 1, 1, 2, -1])
PLAIN = np.array([True, True, False])
HELD = [0, 1, 2, 3, 4, 5]


def kinds(ids):
    """Numbers of parametrisations; beyond them there is no landmark."""
    return np.where(ids < NUMBERS.size, NUMBERS[np.minimum(ids, NUMBERS.size - 1)], -1)


class Anything(ObservationModel):
    """A model that is not called."""

    dim = 1

    def predict(self, state, landmark=None, const=None, substate=None):
        raise AssertionError


def group(ids, **options) -> Observations:
    ids = np.array(ids)
    return Observations(np.zeros((ids.shape[-1], 1)), np.ones((ids.shape[-1], 1, 1)), Anything(), ids=ids, **options)


def rows_of(plan: Plan) -> list[Row]:
    """Every row of a plan, batches taken apart."""
    rows = [row for rows in plan.joint for row in rows] + list(plan.mixtures)
    for batch in plan.batches:
        for j, (k, landmark) in enumerate(zip(batch.ks.tolist(), batch.ids.tolist(), strict=True)):
            mask = None if batch.mask is None else batch.mask[:, j]
            rows.append(Row(batch.group, k, landmark, mask))
    return rows


def matrix(rows: list[Row], count: int, groups: int) -> np.ndarray:
    """Ids (groups, N, count) that rows speak of, −1 elsewhere."""
    out = np.full((groups, N, count), NULL)
    for row in rows:
        mask = np.ones(N, dtype=bool) if row.mask is None else row.mask
        assert (out[row.group, mask, row.k] == NULL).all()
        out[row.group, mask, row.k] = row.landmark
    return out


@st.composite
def id_arrays(draw):
    """Ids (K,) or (N, K); a landmark may be named several times."""
    count = draw(st.integers(1, 4))
    one = st.sampled_from([NULL, NEW, *HELD])
    shape = (N, count) if draw(st.booleans()) else (count,)
    flat = draw(st.lists(one, min_size=int(np.prod(shape)), max_size=int(np.prod(shape))))
    return np.array(flat).reshape(shape)


@given(st.lists(id_arrays(), min_size=1, max_size=3))
def test_every_row_appears_once_and_overlaps_are_stacked(all_ids):
    plan = make_plan([group(ids) for ids in all_ids], N, kinds, PLAIN)
    found = matrix(rows_of(plan), max(ids.shape[-1] for ids in all_ids), len(all_ids))
    for g, ids in enumerate(all_ids):
        expected = np.broadcast_to(np.where(ids >= 0, ids, NULL), (N, ids.shape[-1]))
        np.testing.assert_array_equal(found[g, :, : ids.shape[-1]], expected)
    for batch in plan.batches:
        assert np.unique(kinds(batch.ids)).size == 1
        assert PLAIN[kinds(batch.ids[:1])[0]]
    assert all(not PLAIN[kinds(np.array([row.landmark]))[0]] for row in plan.mixtures)
    together = {rows[0].landmark for rows in plan.joint}
    assert all(len({row.landmark for row in rows}) == 1 for rows in plan.joint)
    for landmark in HELD[:5]:
        per_particle = (found == landmark).sum(axis=(0, 2))
        assert (landmark in together) == bool((per_particle > 1).any())


def test_impossible_clutter_only_counts_where_there_is_some():
    plan = make_plan([group([[NULL], [0], [0], [0]], log_clutter=-np.inf)], N, kinds, PLAIN)
    assert plan.log_factor.tolist() == [-np.inf, 0.0, 0.0, 0.0]


def test_the_common_case_is_one_batch_without_masks():
    plan = make_plan([group([2, NULL, 0, 1])], N, kinds, PLAIN)
    assert len(plan.batches) == 1
    assert plan.batches[0].ids.tolist() == [2, 0, 1]
    assert plan.batches[0].ks.tolist() == [0, 2, 3]
    assert plan.batches[0].mask is None
    same_in_all = make_plan([group([[2, 0]] * N)], N, kinds, PLAIN)
    assert [batch.mask for batch in same_in_all.batches] == [None]
    nothing = make_plan([group(np.zeros(0, dtype=int))], N, kinds, PLAIN)
    assert (nothing.batches, nothing.joint, nothing.mixtures) == ([], [], [])


@pytest.mark.parametrize("ids", [[6], [7], [[0]] * (N - 1) + [[6]]])
def test_landmarks_that_are_not_held(ids):
    with pytest.raises(InputError, match=r"is of landmark [67], which is not in the map"):
        make_plan([group(ids)], N, kinds, PLAIN)


# Reading and projecting by drivers against the store's own columns and the models in NumPy.

CAMERA = Pinhole(640, 480, 400.0, 400.0, 319.5, 239.5, (-0.1, 0.02, 0.001, -0.001, 0.0))


def grown(n: int, rng: np.random.Generator) -> tuple[LandmarkMap, Lineage, np.ndarray, np.ndarray]:
    """A map of points and rays of several generations, the first of which have gone cold."""
    lineage, landmark_map = Lineage(n), LandmarkMap(SE3)
    landmark_map.begin(n, lineage)
    points, rays = [], []
    for _ in range(6):
        spread = 0.02 * rng.normal(size=(n, 2, 3, 3))
        cov = spread @ np.swapaxes(spread, -1, -2)
        mean = rng.uniform([-1, -1, 3], [1, 1, 5], (2, 3)) + 0.02 * rng.normal(size=(n, 2, 3))
        points.append(landmark_map.add_records(Records(mean, cov), Point(3)))
        anchor = SE3.exp(0.02 * rng.normal(size=(n, 2, 6)))
        bearing = np.array([0.1, -0.1, 0.3]) + 0.02 * rng.normal(size=(n, 2, 3))
        rays.append(landmark_map.add_records(Records(bearing, cov, anchor), InverseDepth()))
        ancestors = np.sort(rng.integers(0, n, n))
        lineage.advance(ancestors)
        landmark_map.resample(ancestors)
    return landmark_map, lineage, np.concatenate(points), np.concatenate(rays)


@pytest.mark.parametrize("n", [7, 300])
@pytest.mark.parametrize("some", [slice(None), slice(3, 4), slice(2, 6), np.array([5, 0, 5])], ids=str)
def test_records_are_the_columns(n, some):
    """Of all particles or some, warm or cold."""
    landmark_map, _, points, rays = grown(n, np.random.default_rng(0))
    for layout, ids in zip(landmark_map.layouts, (points, rays), strict=True):
        assert (landmark_map.store.columns.slab[ids[-2:]] >= 0).all()
        for chosen in (ids[-2:], ids):
            read = landmark_map.read(chosen, some)
            plain = layout.unpack(np.array([landmark_map.store.read(int(i)) for i in chosen]))
            np.testing.assert_array_equal(read.mean, plain.mean[some])
            np.testing.assert_array_equal(read.cov, plain.cov[some])
            if plain.const is not None:
                np.testing.assert_array_equal(read.const, plain.const[some])


@pytest.mark.parametrize("camera_model", [CameraPoint, CameraRay, EpipolarRay])
def test_innovations_in_the_heaviest_particle_equal_numpys(camera_model):
    rng, n, k = np.random.default_rng(4), 7, 4
    landmark_map, _, points, rays = grown(n, rng)
    ids = (points if camera_model is CameraPoint else rays)[-k:]
    state = SE3.exp(0.05 * rng.normal(size=(n, 6)))
    prior = Prior(SE3, state, np.zeros((1, 6)), np.zeros((1, 6, 6)))
    log_weights = np.log(np.arange(1.0, n + 1.0) / 28.0)
    belief = Belief(log_weights, prior, {Part.LANDMARK: landmark_map})
    model, z = camera_model(CAMERA), rng.uniform([200, 100], [400, 300], (k, 2))
    found = belief.innovations(model, z, ids)
    landmark_map.compiled = False
    for part, expected in zip(found, belief.innovations(model, z, ids), strict=True):
        assert part.shape == expected.shape
        np.testing.assert_allclose(part, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("n", [7, 300])
@pytest.mark.parametrize("shared", [True, False], ids=["one factor", "own factors"])
def test_projections_equal_numpys(n, shared):
    rng = np.random.default_rng(2)
    landmark_map, _, points, rays = grown(n, rng)
    factor = 0.01 * rng.normal(size=(1 if shared else n, 6, 6))
    prior = Prior(SE3, SE3.exp(0.02 * rng.normal(size=(n, 6))), 0.01 * rng.normal(size=(n, 6)), factor, centred=False)
    weights = rng.uniform(size=n)
    belief = Belief(np.log(weights / weights.sum()), prior, {Part.LANDMARK: landmark_map})
    point, ray, slab = CameraPoint(CAMERA), CameraRay(CAMERA), landmark_map.store.columns.slab
    assert (slab[points[-2:]] >= 0).all() and (slab[rays[-2:]] >= 0).all()
    assert n == 7 or min(slab[points[:2]].min(), slab[rays[:2]].min()) < 0  # of some, few records are left
    constraint = EpipolarRay(CAMERA), rays[-2:]
    for model, ids in ((point, points[-2:]), (ray, rays[-2:]), (point, points[:4]), (ray, rays[:4]), constraint):
        mean, cov = belief.project(model, ids)
        landmark_map.compiled = False
        expected_mean, expected_cov = belief.project(model, ids)
        landmark_map.compiled = True
        np.testing.assert_allclose(mean, expected_mean, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(cov, expected_cov, rtol=1e-10, atol=1e-10)
