"""Nonlinear least squares on a manifold: Levenberg-Marquardt by singular values (S05 §III-C).

K. Levenberg (1944) and D. Marquardt (1963). Minimises ½‖ε(x)‖² with the correction x ⊕ (−χ), where χ solves
S05 (15)–(16) with d = 0 in the least-squares sense,

    [J; λI] χ = [ε; 0],    J = ∂ε/∂ξ of ε(x ⊕ ξ),    Mathematics (vo-step).

With J = U S Vᵀ that is χ = V diag(s / (s² + λ²)) Uᵀε for every λ, so that retrying a step with more damping needs no new
decomposition. λ follows the ratio of actual to predicted decrease (H. B. Nielsen 1999).

The state x is whatever `retract` moves: a pose (`SE3.retract`), a vector (`np.add`), or any object of the caller's that
holds several of these.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Generic, TypeVar

import numpy as np

from rbpf.errors import InputError
from rbpf.lie import Array
from rbpf.ranges import NotNegative, Positive, Range, Ranged

State = TypeVar("State")

#: x → whitened residuals (m,), and their derivative (m, d) in the chart at x; infinite where x is not admissible.
Evaluate = Callable[[State], tuple[Array, Array]]
Retract = Callable[[State, Array], State]  #: x moved by ξ (d,).
#: Singular values are raised to at least this fraction of the largest: a smaller one means an undetermined direction.
SINGULAR = 1e-7
#: A decrease below this fraction of the squared residuals is within rounding errors: no step is taken for it.
ROUNDING = 1e-12
STUCK = 1e8  #: Damping beyond this multiple of the largest singular value ends the iteration: the step is zero.


@dataclass(frozen=True)
class Rule(Ranged):
    """Stopping criteria and initial damping."""

    #: the iteration has converged once the remaining step to the minimum of the linearised problem is below this, in
    #: standard deviations of the solution (D. Bates and D. Watts 1981).
    offset: Positive = 1e-6
    iterations: Annotated[int, Range(ge=1, le=100000)] = 50  #: maximum number.
    damping: NotNegative = 1e-4  #: the first λ, as a fraction of the largest singular value.


@dataclass(frozen=True)
class Minimum(Generic[State]):
    """The result of the iteration."""

    x: State  #: the state.
    residual: Array  #: (m,) ε there.
    s: Array  #: (d,) singular values of J there, descending.
    vt: Array  #: (d, d) its right singular vectors, by rows.
    iterations: int  #: number of steps tried.
    converged: bool  #: whether the remaining step is below `Rule.offset`.

    @property
    def squared(self) -> float:
        """‖ε‖²."""
        return float(self.residual @ self.residual)

    @property
    def factor(self) -> Array:
        """V S⁻¹ (d, d), a square root of `cov`."""
        return self.vt.T / np.maximum(self.s, SINGULAR * self.s[0])

    @property
    def cov(self) -> Array:
        """(JᵀJ)⁻¹ = V S⁻² Vᵀ (d, d): the covariance of the solution if the whitened residuals have variance one.

        A direction that the residuals do not determine gets a very large, finite variance.
        """
        return self.factor @ self.factor.T


def minimise(evaluate: Evaluate[State], x: State, retract: Retract[State], rule: Rule | None = None) -> Minimum[State]:
    """The local minimum of ½‖ε(x)‖² reached from x.

    Raises InputError: there are fewer residuals than unknowns, or at the start they or their derivative are not
    finite or the derivative is zero.
    """
    rule = rule or Rule()
    residual, jac = evaluate(x)
    if jac.shape[0] < jac.shape[1]:
        raise InputError(f"least squares needs as many residuals as unknowns, got {jac.shape[0]} and {jac.shape[1]}")
    if not (np.isfinite(residual).all() and np.isfinite(jac).all()):
        raise InputError("the residuals or their derivative are not finite at the start of least squares")
    if not jac.any():
        raise InputError("the residuals of least squares do not depend on the unknowns at the start")
    squared, along, s, vt = _linearised(residual, jac)
    damping, growth, iterations = rule.damping * float(s[0]), 2.0, 0
    while True:
        # `along` is the undamped step to the linearised minimum, in standard deviations of the solution.
        converged = bool(np.linalg.norm(along) <= max(rule.offset, np.sqrt(ROUNDING * squared)))
        if converged or iterations >= rule.iterations or damping > STUCK * s[0]:
            return Minimum(x, residual, s, vt, iterations, converged)
        iterations += 1
        # The damped step, and the decrease of ‖ε‖² that the linearised problem predicts for it.
        squares = s**2
        step = vt.T @ (s / (squares + damping**2) * along)
        fractions = squares * (squares + 2.0 * damping**2) / (squares + damping**2) ** 2
        tried = retract(x, -step)
        found, slope = evaluate(tried)
        gain = (squared - float(found @ found)) / float(fractions @ along**2)
        if gain > 0.0 and np.isfinite(slope).all():
            x, residual = tried, found
            squared, along, s, vt = _linearised(found, slope)
            damping, growth = damping * np.sqrt(max(1.0 / 9.0, 1.0 - (2.0 * gain - 1.0) ** 3)), 2.0
        else:
            damping, growth = growth * max(damping, SINGULAR * float(s[0])), 2.0 * growth


def _linearised(residual: Array, jac: Array) -> tuple[float, Array, Array, Array]:
    """‖ε‖², and in the axes of J = U S Vᵀ: Uᵀε (d,), the singular values (d,), and Vᵀ (d, d)."""
    # [J ε] = Q [R r]: R has J's singular values and V, and r = Qᵀε; the triangle has only as many rows as unknowns plus one.
    size = jac.shape[1]
    triangle = np.asarray(np.linalg.qr(np.column_stack([jac, residual]), mode="r"))
    u, s, vt = np.linalg.svd(triangle[:size, :size])
    # No step along undetermined directions.
    along = np.where(s > SINGULAR * s[0], u.T @ triangle[:size, size], 0.0)
    return float(residual @ residual), along, s, vt
