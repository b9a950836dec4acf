"""Shapes of arrays in signatures: `Float[np.ndarray, "N K p"]`, `Like[ArrayLike, "... E"]`.

For a type checker, and at run time, these are `typing.Annotated`: an array with a string that says its axes. The tests
import jaxtyping (P. Kidger) before the package, get its types here, and check every call against them; the package
needs no jaxtyping. The strings are in its notation: a letter is an axis, the same letter the same length in one
call; `...` and `*name` any number of axes; `#` in front of an axis says that it may be 1.

Letters: N particles, K observations, E state storage, d its tangent, m linear substate, D landmark, A its constants,
C components, p measurement, r noise rank.
"""

import sys
from typing import TYPE_CHECKING
from typing import Annotated as Like

if TYPE_CHECKING or "jaxtyping" not in sys.modules:
    from typing import Annotated as Bool
    from typing import Annotated as Float
    from typing import Annotated as Int
else:
    from jaxtyping import Bool, Float, Int

__all__ = ["Bool", "Float", "Int", "Like"]
