"""How a landmark's estimate lies in a record of fixed size.

Per component the mean (D) and the covariance's lower triangle by rows (D(D+1)/2); the components' log-weights where there are
several; the constants (A); where the map keeps them, the log-odds that the landmark exists.
"""

from dataclasses import dataclass

import numpy as np

from rbpf import gaussian
from rbpf.core.models import Landmark, Records
from rbpf.errors import InputError


@dataclass(frozen=True)
class Layout:
    """Sizes and places of a parametrisation's fields."""

    landmark: Landmark
    evidence: bool = False

    @property
    def gaussian_fields(self) -> int:
        """Mean and packed covariance of one component."""
        dim = self.landmark.dim
        return dim + dim * (dim + 1) // 2

    @property
    def fields(self) -> int:
        """Numbers per record."""
        components = self.landmark.components
        weights = components if components > 1 else 0
        return components * self.gaussian_fields + weights + self.landmark.constants + self.evidence

    def pack(self, records: Records, log_odds: np.ndarray | None = None) -> np.ndarray:
        """Records of K landmarks as columns (K, fields, N).

        Raises InputError: the shapes do not fit, or a number is not finite.
        """
        n, k = records.mean.shape[:2]
        dim, components = self.landmark.dim, self.landmark.components
        middle = (components,) if components > 1 else ()
        name = type(self.landmark).__name__
        if records.mean.shape != (n, k, *middle, dim) or records.cov.shape != (n, k, *middle, dim, dim):
            raise InputError(
                f"{name} has {components} component(s) of dimension {dim}: expected means {(n, k, *middle, dim)}, "
                f"got means {records.mean.shape} and covariances {records.cov.shape}"
            )
        if (records.log_weights is None) != (components == 1):
            raise InputError(f"{name} needs log_weights exactly if it has several components")
        if (records.const is None) != (self.landmark.constants == 0):
            raise InputError(f"{name} has {self.landmark.constants} constants per landmark: give them in Records.const")
        body = np.concatenate([records.mean, gaussian.pack(records.cov)], axis=-1)
        body = body.reshape(n, k, self.landmark.components * self.gaussian_fields)
        parts = [body]
        if records.log_weights is not None:
            parts.append(records.log_weights)
        if records.const is not None:
            parts.append(np.broadcast_to(records.const, (n, k, self.landmark.constants)))
        if self.evidence:
            parts.append(np.zeros((n, k, 1)) if log_odds is None else log_odds[..., None])
        columns = np.concatenate(parts, axis=-1)
        if not np.isfinite(body).all():
            raise InputError(f"a new {type(self.landmark).__name__} has a mean or covariance that is not finite")
        return np.ascontiguousarray(np.moveaxis(columns, 0, -1))

    def unpack(self, columns: np.ndarray) -> Records:
        """Columns (K, fields, N) as records."""
        rows = np.moveaxis(columns, -1, 0)
        n, k = rows.shape[:2]
        dim, components = self.landmark.dim, self.landmark.components
        end = components * self.gaussian_fields
        body = rows[..., :end].reshape(n, k, components, self.gaussian_fields)
        mean, cov = body[..., :dim], gaussian.unpack(body[..., dim:], dim)
        log_weights = None
        if components > 1:
            log_weights, end = rows[..., end : end + components], end + components
        else:
            mean, cov = mean[:, :, 0], cov[:, :, 0]
        const = rows[..., end : end + self.landmark.constants] if self.landmark.constants else None
        return Records(mean, cov, const, log_weights)
