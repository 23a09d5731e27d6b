"""Where in the map the robot is, when that is not known: after the start in a stored map, or after it was carried off.

Until it is found the robot maps on as ever, in a part of the graph that nothing joins to the older one.
"""

from __future__ import annotations

from estimator import absolute, se2
from estimator.state import State


def begin(state: State) -> bool:
    """Say that the robot may be anywhere in the map; False where there is no map yet that it could be found in."""
    atlas = state.atlas
    if not atlas.settled():
        return False
    if atlas.adrift is not None:
        forget_adrift(state)
    atlas.cut(state.next_key)
    return True


def forget_adrift(state: State) -> None:
    """Let go of the keyframes of a part that has never been placed."""
    gone = [frame for key, frame in state.keyframes.items() if key >= state.atlas.since]
    for frame in gone:
        del state.keyframes[frame.key]
        if state.settings.history:
            state.retired[frame.key] = frame.submap, se2.between(frame.submap.T_odom_submap, frame.T_odom_keyframe)


def places(state: State) -> int | None:
    """How many places fit, None where the place is known (see `StepResult.places`); light alone may know it too."""
    lit = state.absolute is not None and state.absolute.placed and absolute.blind(state)
    return None if state.atlas.adrift is None or lit else 0
