"""Pose estimation from lidar, ceiling lamps, odometry and gyro: SI arrays in, poses with covariance out.

The package uses no operating system, no devices and no clock. This module exports the names that other packages need. A
module loads when one of its names is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from estimator.lazy_exports import exports_of

if TYPE_CHECKING:
    from estimator.cdma.air_interface import PROFILES as PROFILES
    from estimator.cdma.air_interface import Profile as Profile
    from estimator.cdma.decoder import decode as decode
    from estimator.cdma.decoder import new_decoder as new_decoder
    from estimator.cdma.decoder import search as search
    from estimator.cdma.epoch import UNUSABLE as UNUSABLE
    from estimator.cdma.epoch import BlockFlag as BlockFlag
    from estimator.cdma.epoch import LightEpoch as LightEpoch
    from estimator.cdma.epoch import SampleBlock as SampleBlock
    from estimator.cdma.gold_codes import gold_codes as gold_codes
    from estimator.fusion.motion_model import LARGEST_TURN as LARGEST_TURN
    from estimator.fusion.motion_model import LONGEST_CARRY_S as LONGEST_CARRY_S
    from estimator.fusion.motion_model import UNSEEN as UNSEEN
    from estimator.job_queue import JOB_FUNCTIONS as JOB_FUNCTIONS
    from estimator.light_filter.light_channel import LightsSetup as LightsSetup
    from estimator.light_filter.residual_map import ResidualMap as ResidualMap
    from estimator.light_filter.survey import Lamp as Lamp
    from estimator.light_filter.survey import Receiver as Receiver
    from estimator.light_filter.survey import Survey as Survey
    from estimator.mapping.constraints import Constraints as Constraints
    from estimator.mapping.floorplan_import import image_of_cells as image_of_cells
    from estimator.mapping.grid_patches import Cells as Cells
    from estimator.mapping.grid_patches import Patch as Patch
    from estimator.mapping.grid_patches import Tile as Tile
    from estimator.mapping.keyframe import Keyframe as Keyframe
    from estimator.mapping.keyframe import Settled as Settled
    from estimator.mapping.keyframe import Submap as Submap
    from estimator.mapping.live_grid import LiveGrid as LiveGrid
    from estimator.mapping.live_grid import Progress as Progress
    from estimator.mapping.live_grid import Task as Task
    from estimator.mapping.live_grid import advance as advance
    from estimator.mapping.live_grid import at_once as at_once
    from estimator.mapping.map_snapshot import Identity as Identity
    from estimator.mapping.map_snapshot import MapImage as MapImage
    from estimator.mapping.map_snapshot import Piece as Piece
    from estimator.mapping.map_snapshot import finished as finished
    from estimator.mapping.map_state import MapState as MapState
    from estimator.mapping.occupancy_grid import Grid as Grid
    from estimator.mapping.submap_graph import SubmapGraph as SubmapGraph
    from estimator.match_entry import Entry as Entry
    from estimator.match_entry import LightSaid as LightSaid
    from estimator.match_entry import entry_of as entry_of
    from estimator.measurements import UNLIMITED as UNLIMITED
    from estimator.measurements import Answer as Answer
    from estimator.measurements import Beam as Beam
    from estimator.measurements import Beams as Beams
    from estimator.measurements import Command as Command
    from estimator.measurements import DegradationLevel as DegradationLevel
    from estimator.measurements import Imu as Imu
    from estimator.measurements import Job as Job
    from estimator.measurements import Limits as Limits
    from estimator.measurements import Odometry as Odometry
    from estimator.measurements import Order as Order
    from estimator.measurements import Record as Record
    from estimator.measurements import Scan as Scan
    from estimator.measurements import no_lap as no_lap
    from estimator.numerics import se2 as se2
    from estimator.numerics.arrays import Array as Array
    from estimator.numerics.jit_cache import CACHE_DIR as CACHE_DIR
    from estimator.numerics.jit_cache_file import CACHE_REPORT as CACHE_REPORT
    from estimator.pipeline import keyframe_poses as keyframe_poses
    from estimator.pipeline import render_map as render_map
    from estimator.pipeline import step as step
    from estimator.relocalisation.hypothesis_tracking import SearchedAside as SearchedAside
    from estimator.relocalisation.hypothesis_tracking import near as near
    from estimator.relocalisation.map_reset import forget_map as forget_map
    from estimator.result import SURPRISE as SURPRISE
    from estimator.result import Fix as Fix
    from estimator.result import LightsResult as LightsResult
    from estimator.result import Link as Link
    from estimator.result import LinkState as LinkState
    from estimator.result import Loop as Loop
    from estimator.result import LoopReason as LoopReason
    from estimator.result import MatchResult as MatchResult
    from estimator.result import Reason as Reason
    from estimator.result import SlowError as SlowError
    from estimator.result import SlowErrors as SlowErrors
    from estimator.result import StepResult as StepResult
    from estimator.result import Virtual as Virtual
    from estimator.scan_matching import icp as icp
    from estimator.scan_matching import local_map as local_map
    from estimator.scan_matching import match_trace as match_trace
    from estimator.scan_matching import scan_matcher as scan_matcher
    from estimator.scan_matching.deskew import ScanPoints as ScanPoints
    from estimator.scan_matching.match_memory import MatchMemory as MatchMemory
    from estimator.scan_matching.match_trace import Iteration as Iteration
    from estimator.scan_matching.match_trace import Pairs as Pairs
    from estimator.scan_matching.match_trace import Told as Told
    from estimator.scan_matching.scan_matcher import Asked as Asked
    from estimator.state import Settings as Settings
    from estimator.state import State as State
    from estimator.state import new_state as new_state
    from estimator.stored_map import image_of as image_of
    from estimator.stored_map import restored as restored

NAMES_OF: Final = {
    # the method: one step
    "pipeline": "keyframe_poses render_map step",
    "state": "Settings State new_state",
    "relocalisation.map_reset": "forget_map",
    # records that a step consumes, and what it may spend
    "measurements": (
        "Answer Beam Beams Command DegradationLevel Imu Job Limits Odometry Order Record Scan UNLIMITED no_lap"
    ),
    "numerics.arrays": "Array",
    "job_queue": "JOB_FUNCTIONS",
    # results of a step
    "result": (
        "Fix LightsResult Link LinkState Loop LoopReason MatchResult Reason SlowError SlowErrors StepResult SURPRISE "
        "Virtual"
    ),
    # CDMA: air interface, decoder, sample blocks and epochs
    "cdma.air_interface": "PROFILES Profile",
    "cdma.gold_codes": "gold_codes",
    "cdma.decoder": "decode new_decoder search",
    "cdma.epoch": "BlockFlag LightEpoch SampleBlock UNUSABLE",
    # lamps, receiver, and the light filter's setup
    "light_filter.survey": "Lamp Receiver Survey",
    "light_filter.residual_map": "ResidualMap",
    "light_filter.light_channel": "LightsSetup",
    # map: keyframes, submaps, grids, snapshots
    "mapping.keyframe": "Keyframe Settled Submap",
    "mapping.constraints": "Constraints",
    "mapping.submap_graph": "SubmapGraph",
    "mapping.map_state": "MapState",
    "mapping.map_snapshot": "Identity MapImage Piece finished",
    "stored_map": "image_of restored",
    "mapping.floorplan_import": "image_of_cells",
    "mapping.occupancy_grid": "Grid",
    "mapping.grid_patches": "Cells Patch Tile",
    "mapping.live_grid": "LiveGrid Progress Task advance at_once",
    # uncertainty of a pose that nothing updates; hypotheses
    "fusion.motion_model": "LARGEST_TURN LONGEST_CARRY_S UNSEEN",
    "relocalisation.hypothesis_tracking": "SearchedAside near",
    # one match, traced for plots
    "scan_matching.deskew": "ScanPoints",
    "scan_matching.match_memory": "MatchMemory",
    "scan_matching.scan_matcher": "Asked",
    "scan_matching.match_trace": "Iteration Pairs Told",
    "match_entry": "Entry LightSaid entry_of",
    "": "scan_matching.icp scan_matching.local_map scan_matching.match_trace scan_matching.scan_matcher numerics.se2",
    # numerics
    "numerics.jit_cache": "CACHE_DIR",
    "numerics.jit_cache_file": "CACHE_REPORT",
}
"""Exported names by module; modules themselves under the empty key."""

if not TYPE_CHECKING:
    __getattr__, __dir__, __all__ = exports_of(__name__, NAMES_OF)
