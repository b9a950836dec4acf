"""Shapes of arrays in signatures: `Float[np.ndarray, "N K p"]`, `Like[ArrayLike, "... E"]`; arrays for kernels.

For a type checker, and at run time, these are `typing.Annotated`. The tests import jaxtyping (P. Kidger) before the
package, so that these become its types, and check calls against them. The strings are in its notation: a letter is an
axis, of the same length throughout a call; `...` and `*name` are any number of axes; an axis with `#` may also be 1.

Letters: N particles, K observations, E state storage, d its tangent, m linear substate, D landmark, A its constants,
C components, p measurement, r noise rank.
"""

import sys
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Self
from typing import Annotated as Like

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rbpf.errors import InputError

if TYPE_CHECKING or "jaxtyping" not in sys.modules:
    from typing import Annotated as Bool
    from typing import Annotated as Float
    from typing import Annotated as Int
else:
    from jaxtyping import Bool, Float, Int

__all__ = ["Array", "Bool", "Float", "Int", "Like", "RowByRow", "numbers"]

Array = NDArray[np.float64]


class RowByRow:
    """A dataclass of arrays with equal numbers of rows; other fields apply to all rows."""

    def __len__(self) -> int:
        return len(next(iter(self._arrays().values())))

    def take(self, rows: np.ndarray | slice) -> Self:
        """A subset of the rows, by index or mask."""
        whole: Any = self
        chosen: Self = replace(whole, **{name: array[rows] for name, array in self._arrays().items()})
        return chosen

    def _arrays(self) -> dict[str, np.ndarray]:
        whole: Any = self
        return {item.name: part for item in fields(whole) if isinstance(part := getattr(self, item.name), np.ndarray)}


def numbers(array: ArrayLike, what: str) -> NDArray[np.float64]:
    """Float64 in native byte order and C order, writable; copied only if necessary. Raises InputError: not real numbers."""
    if type(array) is np.ndarray and array.dtype == np.float64 and array.flags.carray:
        return array
    given = np.asarray(array)
    if given.dtype.kind not in "fiub":
        raise InputError(f"{what} must hold real numbers, got {given.dtype}")
    return np.require(given, np.float64, ["C", "W"])
