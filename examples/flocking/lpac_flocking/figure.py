"""A flight of the flock, beside its expert and robots that do not hear each other.

`python -m lpac_flocking.figure BUNDLE` writes flock.png and flock.pdf.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge.core import F64
from edge.policy.bundle import Bundle, load_bundle
from lpac.analysis import style
from lpac.api import fly
from lpac.sim.points import prepare
from lpac.sim.scenario import Scenario
from lpac_flocking.task import FlockExpert, disagreement_m_s, speed_m_s

_STEP_S = 0.2


def expert_positions_m(scenario: Scenario, bundle: Bundle) -> F64:
    """(T, N, 2): the flight of points that the expert flies, without delay, every 0.2 s."""
    prepared, scale = prepare(scenario, bundle), scenario.scale
    world_size = prepared.perception.world_size
    expert = FlockExpert(world_size, prepared.bundle.manifest.training.max_speed)
    positions = scale.position_to_model(prepared.starts_m)
    velocities, alive = np.zeros_like(positions), np.ones(len(positions), np.bool_)
    flown = [positions]
    for _ in prepared.times_s[1:]:
        velocities = expert.velocities(positions, alive, moving=velocities)
        metres = scale.velocity_to_mission_m_s(velocities) * _STEP_S
        positions = np.clip(positions + scale.position_to_model(metres), 0.0, world_size)
        flown.append(positions)
    return scale.position_to_mission_m(np.array(flown))


def main() -> None:
    """Draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--out", type=Path, default=Path("flock"), help="the files, without .png")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--duration", type=float, default=60.0, help="s")
    told = parser.parse_args()
    bundle = load_bundle(told.bundle)
    scenario = Scenario(seed=told.seed, duration_s=told.duration)
    flown, deaf = fly(scenario, bundle), fly(replace(scenario, loss=1.0), bundle)
    time_s = flown.time_s
    curves = {
        "policy": (flown.positions_m, style.BLUE, "-"),
        "expert": (expert_positions_m(scenario, bundle), style.BLACK, "--"),
        "policy, no messages": (deaf.positions_m, style.VERMILLION, "-."),
    }
    with style.figure(style.WIDTH_IN, 2.6) as figure:
        tracks, alone, right = figure.subplots(1, 3, width_ratios=(1.0, 1.0, 1.3))
        world_m = scenario.perception_of(bundle).world_size / scenario.scale.env_scale
        for axes, flight, title in ((tracks, flown, "policy"), (alone, deaf, "no messages")):
            for robot in range(scenario.robots):
                x_m, y_m = flight.positions_m[:, robot].T
                axes.plot(x_m, y_m, lw=0.7, color=style.SKY)
                axes.plot(x_m[-1], y_m[-1], "o", ms=3.0, color=style.BLUE)
            axes.set(xlim=(0, world_m), ylim=(0, world_m), aspect="equal", title=title, xlabel="m")
        for name, (positions_m, colour, line) in curves.items():
            apart = disagreement_m_s(time_s, positions_m)
            right.plot(time_s[1:], apart, color=colour, ls=line, lw=1.2, label=name)
        right.set(xlabel="time, s", ylabel="velocity disagreement, m/s", ylim=(0.0, None))
        right.legend(fontsize=7)
        style.save(figure, told.out)
    for name, (positions_m, _, _) in curves.items():
        apart, speed = (of(time_s, positions_m) for of in (disagreement_m_s, speed_m_s))
        print(
            f"{name}: in the last 5 s {apart[-25:].mean():.3f} m/s apart, "
            f"the flock at {speed[-25:].mean():.3f} m/s"
        )


if __name__ == "__main__":
    main()
