"""Texts for published numbers (states, link uses, fixes, loop reasons) that have no table of their own elsewhere."""

from __future__ import annotations

from typing import Final

from daemon.publish.modbus.holding import CommandCode
from daemon.snapshot import LightFix, LinkUse, LoopReason, State

STATES: Final[dict[State, str]] = {
    State.STARTING: "starting; there is no pose yet",
    State.NO_LIDAR: "no valid scan for three scan periods, or scans are not steady yet",
    State.MAPPING: "the pose follows the lidar; it is not confirmed yet",
    State.TRACKING: "the pose is known: two solutions agree, or one is confirmed",
    State.DEGRADED: "the pose is known, but an axis or a solution is missing",
    State.AMBIGUOUS: "several poses are possible",
    State.LOST: "the pose is not known",
    State.RELOCATING: "searching for the pose in the map",
}
USES: Final[dict[LinkUse, str]] = {
    LinkUse.OTHER: "not known to this version",
    LinkUse.ACCEPTED: "used",
    LinkUse.OCCLUDED: "weaker than expected here: an object blocks the light; or it fits for less than 0.5 s or 0.15 m",
    LinkUse.REJECTED: "stronger than expected here, or not where the survey has it: moved or exchanged",
    LinkUse.RIM: "at the edge of the receiver's field of view",
    LinkUse.FAINT: "not above the noise",
    LinkUse.TWIN: "two lamps with this code are in view",
    LinkUse.UNSURVEYED: "no lamp with this code is in the survey",
    LinkUse.MISSING: "expected here, but not received: defective or covered",
    LinkUse.PAUSED: "received well, but not used at present",
}
FIXES: Final[dict[LightFix, str]] = {
    LightFix.NONE: "no lamps in view, or too few",
    LightFix.STARTING: "position known; heading and gains are not known yet",
    LightFix.GOOD: "position and heading known",
    LightFix.HELD: "extrapolated by odometry; all links are paused",
    LightFix.AMBIGUOUS: "several poses are possible",
    LightFix.LOST: "the received light contradicts the position; the light filter restarts",
}
LOOPS: Final[dict[LoopReason, str]] = {
    LoopReason.OTHER: "not known to this version",
    LoopReason.NEAR: "lidar: the scan matches the map at the expected pose",
    LoopReason.SEARCHED: "lidar: the scan matches the map at only one of all possible poses",
    LoopReason.SUPPORTED: "lidar, twice: two keyframes at different positions agree",
    LoopReason.LIT: "light and lidar: the same lamps are received, and the scan matches the map there",
    LoopReason.PLACED: "relocalisation: the only pose in the map that fits everything since the pose was lost",
}
COMMANDS: Final[dict[CommandCode, str]] = {
    CommandCode.SET_POSE: "Sets the pose to `x`, `y`, `yaw` in the map. Done when the daemon has accepted it; "
    "the state shows whether it is right. In a stored map the daemon searches within 1 m and 0.5 rad of it "
    "(RELOCATING). After four attempts without a match it searches the whole map. In a map of this run the "
    "pose is set as given, and the map moves with it. Later light can contradict it.",
    CommandCode.RESET: "Forgets map and pose, and begins a new map. Stored maps remain.",
    CommandCode.SAVE_MAP: "Writes the map to the disk. Done when it has been read back.",
    CommandCode.RELOCALISE: "Searches for the pose in the whole map, as after a kidnapping.",
    CommandCode.PAUSE: "Stops mapping, and stops corrections of the pose by the lidar. Light and odometry "
    "continue. The state is DEGRADED, and LOST once nothing determines the pose any more, both with reason "
    "20. Use it in a crowded hall or on a lift. If the robot moves with neither light nor odometry, send "
    "SET_POSE or RELOCALISE afterwards.",
    CommandCode.RESUME: "Ends a pause.",
    CommandCode.DUMP_RECORDER: "Writes the content of the flight recorder to the disk. Done when the dump is complete.",
    CommandCode.SWITCH_MAP: "Saves the map in use, loads the stored map `map_id`, and searches for the pose in it. "
    "Done when the map is in use. Refused if there is no such map; then nothing changes.",
}
