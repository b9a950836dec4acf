"""Batched Lie groups: exponential, logarithm, adjoint, composition, retraction and Jacobians.

Every function broadcasts over leading axes. A tangent is xi = [omega, v], rotation first, and perturbs on the right:
x (+) xi = x Exp(xi). Angles are exact from 0 to pi. Formulas: Sola, Deray and Atchuthan, "A micro Lie theory for state
estimation in robotics" (2018), and Barfoot, "State Estimation for Robotics" (2017), chapter 7.
"""

from rbpf.arrays import Array
from rbpf.lie.base import LieGroup
from rbpf.lie.product import Euclidean, Finite, Product
from rbpf.lie.se2 import SE2Group
from rbpf.lie.se3 import SE3Group, skew

SE2 = SE2Group()
SE3 = SE3Group()

__all__ = ["SE2", "SE3", "Array", "Euclidean", "Finite", "LieGroup", "Product", "SE2Group", "SE3Group", "skew"]
