"""Check of a fused kernel against its NumPy twin."""

from typing import Any

import numpy as np

from rbpf.conformance.arguments import Scene
from rbpf.conformance.calls import FindingError, named, require, require_close, require_type
from rbpf.core.models import FusedKernel, Jacobians, ObservationModel
from rbpf.core.numeric import numeric_jacobians
from rbpf.kernels.signature import BLOCK
from rbpf.kernels.single import call_kernel

KERNEL_TOLERANCE = 1e-9
GUARD = 64 * BLOCK
"""Numbers in front of and behind each output, which the kernel must leave alone."""
_MARK = 1.5e300
_OUTPUTS = ("nu", "jac_state", "jac_landmark")


def check_kernel(model: ObservationModel, scene: Scene, numeric_tolerance: float) -> None:
    """The innovation and the Jacobians of a block of particles, full and partly filled."""
    fused, name = model.kernel(), named(model.kernel)
    require_type(name, fused, FusedKernel, type(None))
    if fused is None or scene.landmark is None:
        return
    plain = isinstance(fused.params, np.ndarray) and fused.params.dtype == float and fused.params.ndim == 1
    require(plain, f"{name} gives params that are not one axis of float64 numbers")
    lanes = scene.lanes()
    analytic = model.jacobians(*lanes.args)
    twin = analytic or numeric_jacobians(model, lanes.space, *lanes.args)
    tolerance = numeric_tolerance if analytic is None else KERNEL_TOLERANCE
    predicted = model.predict(*lanes.args)
    for lane, count in ((0, min(BLOCK, predicted.shape[0])), (1, 3)):
        nu, found = _run(name, fused, lanes, predicted[lane], count)
        expected_nu = model.innovation(predicted[lane], *lanes.args)[:count]
        require_close(f"{name}: nu differs from residual(z, predict)", nu, expected_nu, KERNEL_TOLERANCE)
        for block in ("state", "landmark"):
            what, expected = f"{name}: jac_{block} differs from NumPy's", getattr(twin, block)[:count]
            require_close(what, getattr(found, block), expected, tolerance)


def _run(
    name: str, fused: FusedKernel, lanes: Scene, z: np.ndarray, count: int
) -> tuple[np.ndarray, Jacobians]:
    """ν (count, p) and the Jacobians of the first lanes."""
    assert lanes.landmark is not None
    shapes = ((z.size, BLOCK), (z.size, lanes.space.dim, BLOCK), (z.size, lanes.landmark.shape[-1], BLOCK))
    outputs = [_Guarded(shape) for shape in shapes]
    inputs = [_block(part) for part in (lanes.state, lanes.landmark, lanes.const)]
    try:
        arrays = [output.array for output in outputs]
        call_kernel(fused.function.address, *inputs, np.array(z), fused.params, count, *arrays)
    except AttributeError as error:
        raise FindingError(f"{name} gives no fused kernel: decorate it with @observation_kernel") from error
    for what, output in zip(_OUTPUTS, outputs, strict=True):
        require(output.intact, f"{name} writes outside {what}, which has shape {output.array.shape}")
    _zero_what_is_not_read(outputs[1].array[..., :count])
    for what, output in zip(_OUTPUTS, outputs, strict=True):
        filled = np.isfinite(output.array[..., :count]).all()
        require(filled, f"{name} leaves entries of {what} unfilled, or fills them with NaN")
    nu, by_state, by_landmark = (np.moveaxis(output.array[..., :count], -1, 0) for output in outputs)
    return nu, Jacobians(by_state, by_landmark)


def _zero_what_is_not_read(jac_state: np.ndarray) -> None:
    """The drivers hand over zeros: a kernel need not fill the last columns, of a part of the state that it ignores."""
    untouched = np.isnan(jac_state).all(axis=(0, 2))
    read = int(np.max(np.flatnonzero(~untouched), initial=-1)) + 1
    jac_state[:, read:] = 0.0


class _Guarded:
    """An array of NaN between two guards."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._all = np.full(2 * GUARD + int(np.prod(shape)), _MARK)
        self.array: Any = self._all[GUARD:-GUARD].reshape(shape)
        self.array[...] = np.nan

    @property
    def intact(self) -> bool:
        """Whether the guards hold what they were given."""
        return bool((self._all[:GUARD] == _MARK).all() and (self._all[-GUARD:] == _MARK).all())


def _block(part: np.ndarray | None) -> np.ndarray:
    """(lanes, size) → (size, BLOCK); lanes beyond the last repeat it, so that no lane holds garbage."""
    if part is None:
        return np.zeros((0, BLOCK))
    return np.ascontiguousarray(part[np.minimum(np.arange(BLOCK), part.shape[0] - 1)].T)
