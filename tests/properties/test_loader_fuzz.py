"""Settings, run folders, maps and checkpoints that are damaged or made up: one InputError, and nothing else."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from examples.studies.point_worlds import MONO as CAMERA
from rbpf.core.checkpoint import load_arrays, save_arrays
from rbpf.errors import InputError
from rbpf.lie import SE3
from rbpf.runs.results import load
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.mono.feature_table import PATCH_PX
from rbpf.systems.mono.known_map import KnownMap, known_map_arrays, read_known_map
from rbpf.systems.settings import load_settings
from rbpf.systems.stereo.config import StereoConfig
from rbpf.validation.consistency.comparison import read_comparisons
from rbpf.validation.sweep import read_plan, read_rows
from tests.properties.mutations import damaged, read_or_refused, restored

pytestmark = pytest.mark.slow

FEW = settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
SETTINGS = b"rbpf: 0.1.0\nsystem: mono\nparticles: 20\nray:\n  constrain: marginal\nsearch: {measurements: 25}\n"
SWEEP = b"system: range-bearing\nsequences: [log]\nparticles: [10]\nseeds: 2\noptions: {plain: {}}\n"


ROWS = b'{"key": "a", "figures": {"x": 1}}\n{"key": "b", "figures": {}}\n'
TEXTS = {
    "settings of one camera": (SETTINGS, lambda path: load_settings(MonoConfig, "mono", path, (), {})),
    "settings of two": (SETTINGS, lambda path: load_settings(StereoConfig, "mono", path, (), {})),
    "a sweep": (SWEEP, read_plan),
    "its finished rows": (ROWS, read_rows),
}


@pytest.mark.parametrize(("sound", "read"), TEXTS.values(), ids=TEXTS)
@FEW
@given(data=st.data())
def test_texts(tmp_path_factory, sound, read, data):
    path = tmp_path_factory.getbasetemp() / "text"
    path.write_bytes(data.draw(damaged(sound)))
    read_or_refused(lambda: read(path))


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """The folder of a small run."""
    from rbpf.runs.recordings import RobotRecording, filter_recording
    from rbpf.systems.range_bearing.config import RangeBearingConfig
    from rbpf.validation.finish import finish_run
    from rbpf.validation.simulation.robot import RobotWorld, simulate_robot

    folder = tmp_path_factory.mktemp("run")
    simulate_robot(RobotWorld(steps=5, landmarks=8), folder / "log", seed=0)
    out = folder / "out"
    recording = RobotRecording(folder / "log")
    finish_run(filter_recording(recording, RangeBearingConfig(particles=4), out), out, recording.sources(), batch=False)
    return out


READ = ["config.yaml", "summary.json", "trajectory.npz", "truth.npz", "map.npz", "diagnostics.csv"]


@FEW
@given(data=st.data())
def test_run_folders(run, data):
    path = run / data.draw(st.sampled_from([*READ, "validation_groundtruth.json"]))
    with restored(path) as whole:
        path.write_bytes(data.draw(damaged(whole)))
        read_or_refused(lambda: read_all(run))
        read_or_refused(lambda: load(run).estimate)
        read_or_refused(lambda: read_comparisons(run))


def read_all(run: Path) -> None:
    record = load(run)
    record.path, record.truth, record.map.points(), record.table("diagnostics.csv")


@FEW
@given(data=st.data())
def test_arrays_of_other_shapes_and_types(run, data):
    """An archive that is whole, but in which an array is another one."""
    path = run / data.draw(st.sampled_from(["trajectory.npz", "truth.npz", "map.npz"]))
    arrays = load_arrays(path)
    name = data.draw(st.sampled_from(sorted(arrays)))
    with restored(path):
        save_arrays(path, arrays | {name: data.draw(others(arrays[name]))})
        read_or_refused(lambda: read_all(run))
        read_or_refused(lambda: load(run).estimate)


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> Path:
    """A map to find a camera in."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("known") / "known.npz"
    count, side = 8, PATCH_PX
    found = KnownMap(
        camera=CAMERA,
        alignment="none",
        names=np.arange(count),
        positions=rng.normal(size=(count, 3)),
        cov=np.tile(0.01 * np.eye(3), (count, 1, 1)),
        windows=rng.integers(0, 255, (count, side, side), dtype=np.uint8),
        first_px=rng.uniform(20, 200, (count, 2)),
        first_pose=np.tile(SE3.identity(), (count, 1)),
        views=SE3.identity()[None],
    )
    save_arrays(path, known_map_arrays(found))
    assert read_known_map(path).names.size == count
    return path


@FEW
@given(data=st.data())
def test_maps_to_find_a_camera_in(known, data):
    with restored(known) as whole:
        if data.draw(st.booleans()):
            known.write_bytes(data.draw(damaged(whole)))
        else:
            arrays = load_arrays(known)
            name = data.draw(st.sampled_from(sorted(arrays)))
            save_arrays(known, arrays | {name: data.draw(others(arrays[name]))})
        read_or_refused(lambda: read_known_map(known))


@st.composite
def others(draw: st.DrawFn, array: np.ndarray) -> np.ndarray:
    """An array that has another shape, type or content."""
    kind = draw(st.sampled_from(["shape", "type", "text", "content", "empty", "scalar"]))
    if kind == "shape":
        return np.zeros((*array.shape, 2), array.dtype)
    if kind == "type":
        return array.astype(float) if array.dtype.kind in "iub" else np.zeros(array.shape, np.int64)
    if kind == "text":
        return np.full(array.shape, "x")
    if kind == "empty":
        return array[:0] if array.ndim else np.zeros(0, array.dtype)
    if kind == "scalar" or not array.size:
        return np.array(7)
    changed = array.copy()
    if array.dtype.kind in "if":
        flat = changed.reshape(-1)
        extreme = [-1, -(2**62), 2**62, 7] if array.dtype.kind == "i" else [np.nan, np.inf, -1e300, 0.5]
        flat[draw(st.integers(0, flat.size - 1))] = draw(st.sampled_from(extreme))
    return changed


def member(header: bytes, body: bytes = b"", compressed: bool = False) -> bytes:
    """An archive of one array with such a header."""
    buffer = io.BytesIO()
    npy = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body
    kind = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        archive.writestr("a.npy", npy)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000,)}\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}\n",
        b"{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000000,)}\n",
        b"{'descr': '<U999999999', 'fortran_order': False, 'shape': (1000,)}\n",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\n",
        b"{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,)}\n",
        b"__import__('os').system('touch pwned')\n",
        b"(" * 9000 + b"\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (True,)}\n",
    ],
    ids=["unfolds", "huge", "negative", "no bytes each", "long text", "objects", "records", "code", "nested", "truth"],
)
def test_headers_that_claim_too_much(tmp_path, header):
    unfolds = b"(1000000,)" in header  # it has what it claims, but compressed
    (tmp_path / "a.npz").write_bytes(member(header, b"\0" * (8_000_000 if unfolds else 8), compressed=unfolds))
    with pytest.raises(InputError, match="is damaged or cut off"):
        load_arrays(tmp_path / "a.npz")
    assert not Path("pwned").exists()
