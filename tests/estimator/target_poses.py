"""``python -m tests.estimator.target_poses``: what this machine code makes of a short drive, as JSON on stdout.

Run in child processes by `test_jit_targets`, once for each way of compiling the kernels.
"""

import json
import sys
from dataclasses import replace

import numpy as np

from estimator.numerics import jit
from estimator.paper import LUMILOOP, METHODS, method
from estimator.pipeline import Settings, render_map
from estimator.scan_matching.line_features import lines_of
from tests.estimator.cdma_scene import Run, ceiling
from tests.estimator.lit import lit_state, play, scans, together
from tests.estimator.test_pipeline import drive, scan_at
from tests.estimator.world import points_in
from tools.sim.light.link_drive import room_run


def figures() -> dict[str, list[float]]:
    """Numbers by name: poses of drives with each method and under lamps, lines of a scan, cells, lamps' strengths."""
    out: dict[str, list[float]] = {}
    for name in METHODS:
        state = method(name)(Settings(), None).state
        _, results = drive(state, odometry=True, n=40)
        out[f"poses {name}"] = np.ravel([result.T_odom_base for result in results]).tolist()
        if name == LUMILOOP:
            out["cells"] = [float((render_map(state, 0.1).log_odds > 1.0).sum())]
    out["lines"] = lines_of(points_in(scan_at(np.zeros(3), 0.0, 0)))[:, :4].ravel().tolist()
    run = replace(room_run(seed=1, people=0), seconds=8.0)
    log = play(lit_state(run), together(run.odometry(), run.light(), scans(run)), run.truth)
    out["poses under lamps"] = np.ravel([result.T_odom_base for result in log.results]).tolist()
    epoch = Run(ceiling(1)).settle(12)
    known = np.argsort(epoch.ids)
    out["codes"] = epoch.ids[known].astype(float).tolist()
    out["strengths, uA"] = (1e6 * epoch.amplitude[known]).tolist()
    return out


if __name__ == "__main__":
    json.dump({"directory": jit.CACHE_DIR.name, "figures": figures()}, sys.stdout)
