"""The Stanford plot: error against protection level, one point of the grid a pair of both, colour how often."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from tools.experiments.integrity.report import Summary
from tools.experiments.integrity.run import COLUMNS

LEAST_M: Final = 1e-3
MOST_M: Final = 20.0
CELLS: Final = 90


def stanford(found: Summary, canvas: Any, alert_m: float) -> None:
    """Draw every cycle that had a bound: left of the diagonal the bound held, right of it it misled."""
    from matplotlib.colors import LogNorm

    error, bound = (np.concatenate([track[:, COLUMNS.index(name)] for track in found.cycles]) for name in
                    ("error_m", "bound_m"))  # fmt: skip
    said = np.isfinite(bound)
    error, bound = np.clip(error[said], LEAST_M, MOST_M), np.clip(bound[said], LEAST_M, MOST_M)
    edges = np.geomspace(LEAST_M, MOST_M, CELLS)
    axes = canvas.subplots()
    counts, _, _ = np.histogram2d(error, bound, bins=(edges, edges))
    mesh = axes.pcolormesh(edges, edges, np.where(counts > 0, counts, np.nan).T, norm=LogNorm(), cmap="viridis")
    axes.plot((LEAST_M, MOST_M), (LEAST_M, MOST_M), "k-", lw=1.0, label="error = protection level")
    axes.axhline(alert_m, color="tab:red", lw=1.0, label=f"alert limit, {alert_m:g} m")
    axes.axvline(alert_m, color="tab:red", lw=1.0, ls=":")
    axes.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 0.06))
    beyond = int((error > bound).sum())
    axes.text(
        0.97,
        0.03,
        f"right of the diagonal (misleading): {beyond} of {len(error)} cycles",
        transform=axes.transAxes,
        ha="right",
        fontsize=8,
    )
    axes.set(xscale="log", yscale="log", xlabel="horizontal error, m", ylabel="protection level, m")
    axes.set_title(f"{len(found.found)} scenarios", fontsize=9)
    canvas.colorbar(mesh, label="number of cycles", ax=axes)
