"""Off-line calibration from recorded drives: lamps, receiver, odometry, lidar mount.

A module is loaded when one of its names is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from estimator.lazy_exports import exports_of

if TYPE_CHECKING:
    from estimator.calibration.calibrate import Calibrated as Calibrated
    from estimator.calibration.calibrate import Estimate as Estimate
    from estimator.calibration.calibrate import TooLittle as TooLittle
    from estimator.calibration.calibrate import calibrate_lamps as calibrate_lamps
    from estimator.calibration.lamp_mapping import Heard as Heard
    from estimator.calibration.lamp_mapping import Surveyed as Surveyed
    from estimator.calibration.lamp_mapping import survey as survey
    from estimator.calibration.observations import Rows as Rows
    from estimator.calibration.odometry_calibration import Wheel as Wheel
    from estimator.calibration.odometry_calibration import WheelFit as WheelFit
    from estimator.calibration.odometry_calibration import fit_wheels as fit_wheels
    from estimator.calibration.odometry_calibration import on_base as on_base
    from estimator.calibration.parameters import COMMONS as COMMONS
    from estimator.calibration.parameters import Common as Common
    from estimator.calibration.parameters import Priors as Priors
    from estimator.calibration.parameters import placed as placed
    from estimator.calibration.residual_map_fit import learn as learn
    from estimator.calibration.survey_alignment import Unaligned as Unaligned
    from estimator.calibration.survey_alignment import align as align

NAMES_OF: Final = {
    # lamps and receiver
    "calibrate": "Calibrated Estimate TooLittle calibrate_lamps",
    "observations": "Rows",
    "parameters": "COMMONS Common Priors placed",
    "residual_map_fit": "learn",
    # lamp positions from a drive
    "lamp_mapping": "Heard Surveyed survey",
    "survey_alignment": "Unaligned align",
    # odometry and lidar mount
    "odometry_calibration": "Wheel WheelFit fit_wheels on_base",
}
"""Exported names by module; modules themselves under the empty key."""

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exports_of(__name__, NAMES_OF)
