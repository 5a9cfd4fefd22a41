"""Levenberg-Marquardt steps for a floating-base robot whose joints stay within bounds.

A step minimises |J dq + r|² + |prior (q + dq - rest)|² + λ |dq|². It is kept when the cost falls, and λ falls with it;
otherwise it is taken back and λ grows. Without that, a leg that is almost straight, where the model is far off, throws the
next frames about.

Shape letters: R residuals, N velocities (six of the base, then joints). Paper: none; the common damped Gauss-Newton scheme.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.linalg.lapack import get_lapack_funcs

Array = NDArray[np.float64]
#: Configuration to Jacobian (R, N) of the columns that move, and residual (R,), both weighted.
System = Callable[[Array], tuple[Array, Array]]
_EASE: Final = 0.3
_TIGHTEN: Final = 10.0
(_posv,) = get_lapack_funcs(("posv",), dtype=np.float64)
#: Share of the cost that a step has to take off for another one to be worth it.
_LEAST_GAIN: Final = 1e-3


class BoundedSearch:
    """Searches configurations of one robot.

    Args:
        model: Pinocchio's model with a free-flyer base.
        q_columns: places of the joints in a configuration.
        v_columns: places of the base's six velocities and the joints' in a velocity.
        prior: (N - 6,) weight of each joint's distance from `rest`.
        rest: (N - 6,) joints.
        damping: least λ.
    """

    def __init__(
        self,
        model: pin.Model,
        q_columns: NDArray[np.int64],
        v_columns: NDArray[np.int64],
        prior: Array,
        rest: Array,
        damping: float,
    ) -> None:
        self._model, self._q, self._v = model, q_columns, v_columns
        self._prior, self._rest, self._damping = prior, rest, damping
        self._prior_curvature = np.concatenate([np.zeros(6), prior**2])

    def __call__(self, q: Array, system: System, lower: Array, upper: Array, iterations: int) -> Array:
        """The best configuration found.

        Args:
            q: where to start.
            system: what is minimised.
            lower: (N - 6,) least joints.
            upper: (N - 6,) greatest joints.
            iterations: evaluations of the system.
        """
        best, damping, cost = q, self._damping, np.inf
        hessian = gradient = np.empty(0)
        width = len(self._v)
        for left in range(iterations - 1, -1, -1):
            jacobian, residual = system(q)
            away = self._prior * (q[self._q] - self._rest)
            new = float(residual @ residual + away @ away)
            if new <= cost:
                best, gained, cost = q, cost - new, new
                if gained < _LEAST_GAIN * cost:
                    break
                damping = max(damping * _EASE, self._damping)
            else:
                damping *= _TIGHTEN
            if not left:  # a step that nobody would look at
                break
            if best is q:
                hessian = jacobian.T @ jacobian
                gradient = jacobian.T @ residual
                gradient[6:] += self._prior * away
                hessian.reshape(-1)[:: width + 1] += self._prior_curvature
            damped = hessian.copy()
            damped.reshape(-1)[:: width + 1] += damping
            here = best[self._q]
            step = np.zeros(self._model.nv)
            step[self._v] = bounded_step(damped, gradient, lower - here, upper - here)
            q = pin.integrate(self._model, best, step)
            q[self._q] = np.minimum(np.maximum(q[self._q], lower), upper)
        return best


def bounded_step(hessian: Array, gradient: Array, lower: Array, upper: Array) -> Array:
    """Newton step whose joint part (all but the first six entries) stays within bounds; joints that would leave are held."""
    step = _solve(hessian, -gradient)
    held = np.zeros(len(step), dtype=bool)
    for _ in range(3):
        joints = step[6:]
        outside = (joints < lower - 1e-12) | (joints > upper + 1e-12)
        if not outside.any():
            break
        held[6:] |= outside
        step[6:] = np.minimum(np.maximum(joints, lower), upper)
        fixed = np.where(held, step, 0.0)
        right = np.where(held, step, -gradient - hessian @ fixed)
        rest = hessian.copy()
        rest[held] = rest[:, held] = 0.0
        rest.reshape(-1)[:: len(step) + 1] += held  # those rows say that held joints keep their value
        step = _solve(rest, right)
    step[6:] = np.minimum(np.maximum(step[6:], lower), upper)
    return step


def _solve(matrix: Array, right: Array) -> Array:
    """Solution for a positive definite matrix; LAPACK as it is, whose wrappers would cost more than the work."""
    _, solution, info = _posv(matrix, right)
    if info:
        raise np.linalg.LinAlgError(f"the damped normal equations are not positive definite (dposv: {info})")
    return solution
