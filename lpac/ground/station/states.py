"""Ground states: their rank, their safety actions, and their changes in words."""

import re

from edge.messages.mission import GroundState, Hold


def rank(state: GroundState) -> tuple[int, str]:
    """Sort key of a state. Robots obey the state of the greater rank."""
    return state.sequence, state.operator


def holds(state: GroundState, hold: Hold) -> bool:
    """Whether the state includes the hold."""
    if not hold.robots:
        actions = {state.safety_action, *state.robot_safety_actions.values()}
        return actions == {"hold"} and not state.waiting
    return all(
        state.safety_action_for(robot) == "hold" and robot not in state.waiting
        for robot in hold.robots
    )


def is_safer(before: GroundState, after: GroundState) -> bool:
    """Whether the change asks the fleet or a robot for another hold, return or landing."""
    if after.safety_action not in ("none", before.safety_action):
        return True
    return any(
        c != "none" and before.safety_action_for(int(r)) != c
        for r, c in after.robot_safety_actions.items()
    )


def describe_changes(before: GroundState, after: GroundState) -> list[str]:
    """Describe the changes for people."""

    def changed(*names: str) -> bool:
        return any(getattr(before, name) != getattr(after, name) for name in names)

    words: list[str] = []
    if changed("safety_action", "robot_safety_actions"):
        actions = (after.safety_action, *after.robot_safety_actions.values())
        safer = is_safer(before, after)
        words.append(next(a for a in actions if a != "none") if safer else "resume")
    if changed("enabled", "robot_enabled"):
        words.append("enable" if after.enabled or any(after.robot_enabled.values()) else "disable")
    words += [name for name in ("origin", "fence", "places") if changed(name)]
    if changed("world_id"):
        words.append(f"world {after.world_id}")
    if changed("trial"):
        words.append(f"trial {after.trial}")
    return words


def next_trial(trial: str) -> str:
    """Name of the next trial: "t1", then "t2", ..."""
    match = re.fullmatch(r"(.*?)(\d+)", trial)
    if match is None:
        return f"{trial}2" if trial else "t1"
    return f"{match[1]}{int(match[2]) + 1}"
