"""A learned residual map as the `lights` filter takes it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimator.light_filter.residual_lookup import look_up
from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Receiver
from estimator.measurements import Array
from estimator.numerics import se2


class Learned:
    """Corrections from a map.

    Args:
        residuals: learned with the survey the filter has. receiver: where it sits on the robot.
    """

    def __init__(self, residuals: ResidualMap, receiver: Receiver) -> None:
        self._map, self._arm = residuals, np.array((receiver.x, receiver.y, 0.0))
        self._index = {lamp_id: k for k, lamp_id in enumerate(residuals.lamp_ids)}

    def at(self, lamp_ids: Sequence[int], T_map_base: Array) -> Array:
        """See `lights_state.Corrections`."""
        x, y, _ = se2.compose(T_map_base, self._arm).tolist()
        out = np.tile((0.0, -1.0, 0.0, 0.0), (len(lamp_ids), 1))
        for i, lamp_id in enumerate(lamp_ids):
            k = self._index.get(lamp_id)
            if k is None:
                continue
            look_up(self._map.mean[k], self._map.sigma[k], self._map.grid[k], x, y, out[i])
            out[i, 1] = np.hypot(out[i, 1], self._map.noise)
        return out
