"""Texts for published numbers (states, link uses, fixes, loop reasons) that have no table of their own elsewhere."""

from __future__ import annotations

from typing import Final

from daemon.publish.modbus.holding import CommandCode
from daemon.snapshot import LightFix, LinkUse, LoopReason, State

STATES: Final[dict[State, str]] = {
    State.STARTING: "warming up, nothing to say yet",
    State.NO_LIDAR: "no valid scan for three scan periods, or not steadily again",
    State.MAPPING: "the pose follows the laser, but no witness has proved it yet",
    State.TRACKING: "two witnesses agree, or one has proved itself",
    State.DEGRADED: "the pose is held, at least one axis or witness is missing",
    State.AMBIGUOUS: "several places fit",
    State.LOST: "no pose worth using",
    State.RELOCATING: "looking for the place",
}
USES: Final[dict[LinkUse, str]] = {
    LinkUse.OTHER: "something that this version does not know",
    LinkUse.ACCEPTED: "used",
    LinkUse.OCCLUDED: "weaker than it can be here: something stands in its way",
    LinkUse.REJECTED: "stronger than it can be here, or from the wrong place: moved, or exchanged",
    LinkUse.RIM: "at the edge of the receiver's field of view",
    LinkUse.FAINT: "not above the noise",
    LinkUse.TWIN: "two lamps of this code are in view",
    LinkUse.UNSURVEYED: "no lamp of this code is known",
    LinkUse.MISSING: "not received, though it must be here: dead, or covered",
    LinkUse.PAUSED: "clear, but not among those that are used",
}
FIXES: Final[dict[LightFix, str]] = {
    LightFix.NONE: "no lamps in view, or too few",
    LightFix.STARTING: "position known, heading and strengths still being found",
    LightFix.GOOD: "position and heading known",
    LightFix.HELD: "carried on by odometry alone, every link is paused",
    LightFix.AMBIGUOUS: "several places fit",
    LightFix.LOST: "what is received contradicts the position: starting anew",
}
LOOPS: Final[dict[LoopReason, str]] = {
    LoopReason.OTHER: "something that this version does not know",
    LoopReason.NEAR: "laser: the scan fits the map where it was expected",
    LoopReason.SEARCHED: "laser: the scan fits the map in one place of all that were possible",
    LoopReason.SUPPORTED: "laser, twice: two keyframes from different places agree on it",
    LoopReason.LIT: "light and laser: the same lamps are seen from the same place, and the scan fits the map there",
    LoopReason.PLACED: "found in the whole map: the one place that fits all that was seen since the place was lost",
}
COMMANDS: Final[dict[CommandCode, str]] = {
    CommandCode.SET_POSE: "The robot is at `x`, `y`, `yaw` in the map. Done when the order has been taken: whether "
    "the place is right, the state says. In a stored map the robot is looked for within 1 m and 0.5 rad of that "
    "(RELOCATING), and where four looks find nothing there, which are made as it drives, everywhere in it: a wrong "
    "place is not believed, it costs the search. Where the map is this run's own it is taken at its word, and the map "
    "goes along; lamps that know better contradict it later.",
    CommandCode.RESET: "Map and pose are forgotten, a new map is begun. The stored ones stay.",
    CommandCode.SAVE_MAP: "The map is written to the disk. Done when it is there and has been read back.",
    CommandCode.RELOCALISE: "The robot was carried off: it is looked for everywhere in the map.",
    CommandCode.PAUSE: "The map is left alone and the laser does not move the pose, which light and odometry carry; "
    "the state is DEGRADED, LOST once nothing knows the place any more, both with reason 20. For a hall "
    "full of people, or a robot on a lift. With neither light nor odometry nothing follows a robot that moves "
    "meanwhile: SET_POSE or RELOCALISE then.",
    CommandCode.RESUME: "The end of a pause.",
    CommandCode.DUMP_RECORDER: "What the flight recorder holds is written to the disk. Done when it is there.",
    CommandCode.SWITCH_MAP: "The map in use is saved, then the stored map `map_id` is loaded and the robot is looked "
    "for in it. Done when the map is in use; refused where there is no such map, and then nothing changes.",
}
