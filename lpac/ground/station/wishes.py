"""States that a ground tells its fleet: which counts, what they ask, and what changes in words."""

import re

from edge.messages.mission import GroundState, Hold


def rank(state: GroundState) -> tuple[int, str]:
    """Of two states, robots obey that of the greater rank."""
    return state.sequence, state.operator


def holds(state: GroundState, hold: Hold) -> bool:
    """Whether the state has that hold."""
    if not hold.robots:
        actions = {state.safety_action, *state.robot_safety_actions.values()}
        return actions == {"hold"} and not state.waiting
    return all(
        state.safety_action_for(robot) == "hold" and robot not in state.waiting
        for robot in hold.robots
    )


def is_safer(before: GroundState, after: GroundState) -> bool:
    """Whether more is asked to hold, to return or to land than before."""
    if after.safety_action not in ("none", before.safety_action):
        return True
    return any(
        c != "none" and before.safety_action_for(int(r)) != c
        for r, c in after.robot_safety_actions.items()
    )


def changes_in_words(before: GroundState, after: GroundState) -> list[str]:
    """Describe what the ground newly wants, for people."""

    def changed(*names: str) -> bool:
        return any(getattr(before, name) != getattr(after, name) for name in names)

    words: list[str] = []
    if changed("safety_action", "robot_safety_actions"):
        asked = (after.safety_action, *after.robot_safety_actions.values())
        safer = is_safer(before, after)
        words.append(next(c for c in asked if c != "none") if safer else "resume")
    if changed("enabled", "robot_enabled"):
        words.append("enable" if after.enabled or any(after.robot_enabled.values()) else "disable")
    words += [name for name in ("origin", "fence", "places") if changed(name)]
    if changed("world_id"):
        words.append(f"world {after.world_id}")
    if changed("trial"):
        words.append(f"trial {after.trial}")
    return words


def next_trial(trial: str) -> str:
    """The name after this one: "t1", "t2", ..."""
    match = re.fullmatch(r"(.*?)(\d+)", trial)
    if match is None:
        return f"{trial}2" if trial else "t1"
    return f"{match[1]}{int(match[2]) + 1}"
