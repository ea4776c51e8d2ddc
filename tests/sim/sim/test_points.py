"""Simulated flights: repeatable, defined at the edges, and the policy covers."""

import dataclasses
import json

import numpy as np
import pytest

from edge.core import F32
from edge.core.frames import ModelScale
from edge.core.world import GaussianFeature
from edge.policy.bundle import Bundle, BundleError
from lpac.analysis.flight import FlightRecord
from lpac.radio.airtime import Wifi
from lpac.radio.modelled import ModelledRadio
from lpac.sim.failure import Failure
from lpac.sim.flight_summary import summary
from lpac.sim.points import FlightMoment, fly_points
from lpac.sim.scenario import Controller, Scenario
from lpac.sim.ticks import Clocks

CONTROLLERS: tuple[Controller, ...] = (
    "lpac", "decentralized-cvt", "decentralized-cvt-prior", "shared-cvt", "shared-cvt-prior",
    "frontier-cvt", "centralized-cvt", "clairvoyant-cvt",
)  # fmt: skip
MAX_SPEED_M_S = 1.25


def a_scenario(**changes: object) -> Scenario:
    return Scenario(**{"duration_s": 6.0, "robots": 4, **changes})  # type: ignore[arg-type]


def short(bundle: Bundle, **changes: object) -> FlightRecord:
    return fly_points(a_scenario(**changes), bundle)


def importance_of(flight: FlightRecord) -> F32:
    assert flight.coverage is not None
    return flight.coverage.importance


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_seed_gives_one_flight(shipped_bundle: Bundle, controller: Controller) -> None:
    scenarios = [a_scenario(controller=controller, seed=seed, loss=0.2) for seed in (7, 7, 8)]
    texts = [json.dumps(summary(each, fly_points(each, shipped_bundle))) for each in scenarios]
    assert texts[0] == texts[1] != texts[2]


@pytest.mark.parametrize("duration_s", [0.05, 0.2, 1.0, 2.5])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_flight_lasts_as_long_as_asked(
    shipped_bundle: Bundle, controller: Controller, duration_s: float
) -> None:
    flight = short(shipped_bundle, controller=controller, duration_s=duration_s)
    assert flight.time_s[0] == flight.cost_time_s[0] == 0.0
    assert flight.time_s[-1] == flight.cost_time_s[-1] == duration_s
    assert np.all(np.diff(flight.time_s) > 0.0) and np.all(np.diff(flight.time_s) < 0.21)
    assert len(flight.positions_m) == len(flight.time_s)


@pytest.mark.parametrize("controller", ["lpac", "decentralized-cvt"])
def test_who_watches_a_flight_changes_nothing(
    shipped_bundle: Bundle, controller: Controller
) -> None:
    failures = (Failure(2, 1.0, 3.0),) if controller == "lpac" else ()
    scenario = Scenario(robots=4, duration_s=4.5, controller=controller, failures=failures)
    unwatched = fly_points(scenario, shipped_bundle)
    told: dict[float, tuple[np.ndarray, float]] = {}

    def watch(moment: FlightMoment) -> str:
        told[moment.time_s] = moment.positions_m, moment.cost
        assert moment.velocities_m_s.shape == (4, 2)
        assert np.linalg.norm(moment.velocities_m_s, axis=1).max() <= MAX_SPEED_M_S + 1e-9
        away = controller == "lpac" and 1.0 <= moment.time_s < 3.0
        assert moment.alive.tolist() == [True, True, not away, True]
        assert not (moment.received | moment.adjacency)[~moment.alive].any()
        return "ignored"

    watched = fly_points(scenario, shipped_bundle, watch)
    assert summary(scenario, watched) == summary(scenario, unwatched)
    np.testing.assert_array_equal(watched.positions_m, unwatched.positions_m)
    assert list(told) == unwatched.time_s.tolist()
    np.testing.assert_array_equal([p for p, _ in told.values()], unwatched.positions_m)
    assert [told[t][1] for t in unwatched.cost_time_s.tolist()] == unwatched.cost.tolist()


def test_a_robot_hears_whom_it_is_near(shipped_bundle: Bundle) -> None:
    """Without loss, once all have spoken; a robot that is far from the others hears nobody."""
    starts_m = ((2.0, 2.0), (4.0, 3.0), (3.0, 5.0), (31.0, 31.0))
    moments: list[tuple[np.ndarray, np.ndarray]] = []
    scenario = Scenario(robots=4, duration_s=1.0, starts_m=starts_m)
    fly_points(
        scenario, shipped_bundle, lambda moment: moments.append((moment.received, moment.adjacency))
    )
    assert not moments[0][0].any()
    np.testing.assert_array_equal(moments[-1][0], moments[-1][1])
    assert moments[-1][0].sum(axis=1).tolist() == [2, 2, 2, 0]


def test_a_flight_is_stopped(shipped_bundle: Bundle) -> None:
    def stop_at(time_s: float) -> FlightRecord:
        return fly_points(
            Scenario(robots=3, duration_s=4.0),
            shipped_bundle,
            lambda moment: moment.stop() if moment.time_s >= time_s else None,
        )

    stopped = stop_at(1.5)
    whole = fly_points(Scenario(robots=3, duration_s=4.0), shipped_bundle)
    samples = len(stopped.time_s)
    assert 1.5 <= stopped.duration_s == stopped.time_s[-1] == stopped.cost_time_s[-1] < 1.7
    np.testing.assert_array_equal(stopped.positions_m, whole.positions_m[:samples])
    assert stopped.cost[:2].tolist() == whole.cost[:2].tolist()
    with pytest.raises(ValueError, match="stopped at its start"):
        stop_at(0.0)


def test_controllers_and_losses_meet_the_same_world_and_starts(shipped_bundle: Bundle) -> None:
    flights = [short(shipped_bundle, controller=controller) for controller in CONTROLLERS]
    flights.append(short(shipped_bundle, loss=1.0))
    for flight in flights[1:]:
        np.testing.assert_array_equal(importance_of(flight), importance_of(flights[0]))
        np.testing.assert_array_equal(flight.positions_m[0], flights[0].positions_m[0])
        assert flight.cost[0] == flights[0].cost[0]


def test_the_policy_covers_better_than_what_knows_as_much(shipped_bundle: Bundle) -> None:
    """A coarse guard; the bench holds it against the baselines over many worlds."""
    policy, other = (
        fly_points(Scenario(duration_s=15.0, controller=controller), shipped_bundle).normalized[-1]
        for controller in ("lpac", "decentralized-cvt")
    )
    assert policy < 0.8 * other


@pytest.mark.slow
@pytest.mark.parametrize(("robots", "loss"), [(2, 0.0), (10, 0.3), (20, 0.0)])
def test_no_honest_payload_comes_near_the_limit(
    shipped_bundle: Bundle, robots: int, loss: float
) -> None:
    limit = shipped_bundle.manifest.payload_limit
    flight = fly_points(Scenario(robots=robots, loss=loss, duration_s=60.0), shipped_bundle)
    assert limit is not None and 0.0 < flight.largest_payload < 1.05 * limit / 10.0


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("robots", [1, 2])
def test_one_robot_and_two_at_one_point(
    shipped_bundle: Bundle, controller: Controller, robots: int
) -> None:
    starts_m = ((12.0, 20.0),) * robots
    flight = short(shipped_bundle, controller=controller, robots=robots, starts_m=starts_m)
    assert np.isfinite(flight.positions_m).all()
    assert np.any(flight.positions_m[-1] != flight.positions_m[0])
    # Where each decides for itself, both take themselves for the owner.
    if controller in ("lpac", "centralized-cvt", "clairvoyant-cvt") and robots == 2:
        assert np.any(flight.positions_m[-1, 0] != flight.positions_m[-1, 1])


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_robots_on_the_border_and_outside_come_no_further_out(
    shipped_bundle: Bundle, controller: Controller
) -> None:
    starts_m = ((0.0, 0.0), (32.0, 16.0), (-3.0, 16.0), (40.0, 40.0))
    flight = short(shipped_bundle, controller=controller, starts_m=starts_m)
    lowest = np.minimum(starts_m, 0.0)
    highest = np.maximum(starts_m, 32.0)
    assert np.all((flight.positions_m >= lowest) & (flight.positions_m <= highest))
    assert np.isfinite(flight.cost).all()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_world_without_features_costs_nothing(
    shipped_bundle: Bundle, controller: Controller
) -> None:
    flight = short(shipped_bundle, controller=controller, features=())
    assert not importance_of(flight).any()
    assert not flight.cost.any()
    assert not len(flight.normalized)
    assert np.isfinite(flight.positions_m).all()


@pytest.mark.parametrize(
    ("scale", "max_speed_m_s"), [(ModelScale(16.0, 0.25), 1.25), (ModelScale(1.0, 1.0), 5.0)]
)
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_no_robot_is_faster_than_allowed(
    shipped_bundle: Bundle, controller: Controller, scale: ModelScale, max_speed_m_s: float
) -> None:
    flight = short(shipped_bundle, controller=controller, scale=scale)
    steps_m = np.linalg.norm(np.diff(flight.positions_m, axis=0), axis=2)
    limits_m = max_speed_m_s * np.diff(flight.time_s)
    assert np.all(steps_m <= limits_m[:, None] + 1e-9)
    assert steps_m.max() > 0.5 * limits_m.max()


def test_messages_are_lost_delayed_and_out_of_range_as_asked(shipped_bundle: Bundle) -> None:
    together = ((16.0, 16.0), (17.0, 16.0), (16.0, 17.0))
    heard = short(shipped_bundle, robots=3, starts_m=together).message_counts
    assert heard["accepted"] == 2 * heard["broadcasts"] and heard["lost"] == 0

    lossy = short(
        shipped_bundle, robots=3, starts_m=together, loss=0.3, duration_s=60.0
    ).message_counts
    share = lossy["lost"] / (lossy["lost"] + lossy["accepted"])
    assert share == pytest.approx(0.3, abs=0.1)

    late = short(shipped_bundle, robots=3, starts_m=together, delay_s=2.0).message_counts
    assert late["stale"] > 0

    apart = ((1.0, 1.0), (31.0, 31.0))
    deaf = short(shipped_bundle, robots=2, starts_m=apart, duration_s=2.0).message_counts
    assert deaf["broadcasts"] > 0 and deaf["accepted"] == 0


def test_with_a_modelled_radio_messages_are_lost_and_late_as_it_says(
    shipped_bundle: Bundle,
) -> None:
    scenario = a_scenario(
        robots=40, starts_m=((16.0, 16.0),) * 40,
        radio=ModelledRadio("mesh", Wifi(data_rate_mbit_s=60.0)), duration_s=3.0,
    )  # fmt: skip
    flown, link = fly_points(scenario, shipped_bundle), scenario.link
    assert 0.1 < link.loss < 0.9 and link.delay_s > 0.1
    lost, heard = flown.message_counts["lost"], flown.message_counts["broadcasts"] * 39
    assert lost / heard == pytest.approx(link.loss, abs=0.02)
    told = summary(scenario, flown)["link"]
    assert (told["loss"], told["delay_s"]) == link
    assert told["by_model"]["transport"] == "mesh"
    assert told["by_model"]["wifi"]["data_rate_mbit_s"] == 60.0
    assert summary(a_scenario(), short(shipped_bundle))["link"]["by_model"] is None


def test_what_is_said_more_often_is_lost_more_often() -> None:
    radio = ModelledRadio("multicast")
    seldom, often = (
        Scenario(robots=60, radio=radio, clocks=Clocks(policy_s=policy_s)).link
        for policy_s in (0.4, 0.2)
    )
    assert often.loss > 1.5 * seldom.loss


def test_the_papers_mailbox_rule_flies_too(shipped_bundle: Bundle) -> None:
    flight = short(shipped_bundle, max_message_age_s=0.0, delay_s=0.1)
    assert flight.message_counts["accepted"] > 0 and flight.message_counts["stale"] == 0


def test_what_the_swarm_does_depends_on_its_messages(shipped_bundle: Bundle) -> None:
    heard, deaf = (short(shipped_bundle, loss=loss) for loss in (0.0, 1.0))
    assert deaf.message_counts["accepted"] == 0
    assert np.any(heard.positions_m[-1] != deaf.positions_m[-1])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"robots": 0}, "robots = 0: must be from 1 to"),
        ({"duration_s": -1.0}, "duration_s = -1.0: must be above 0 and at most 86400"),
        ({"random_feature_count": -1}, "random_feature_count = -1: must be at least 0"),
        ({"loss": 1.5}, "loss = 1.5: must be from 0 to 1"),
        ({"delay_s": -0.1}, "delay_s = -0.1"),
        ({"max_message_age_s": float("nan")}, "max_message_age_s = nan"),
        ({"starts_m": ((0.0, 0.0),)}, "starts_m: 1 positions for 4 robots"),
        ({"position_bias": ((0.0, 0.0),)}, "position_bias: 1 positions for 4 robots"),
        ({"random_feature_sigma": (9.0, 3.0)}, "random_feature_sigma = \\(9.0, 3.0\\)"),
        ({"max_speed_m_s": 0.0}, "max_speed_m_s = 0.0: must be above 0 and finite"),
        ({"max_input_age_s": 0.0}, "max_input_age_s = 0.0: must be above 0 and finite"),
        ({"lag_s": -1.0}, "lag_s = -1.0"),
        ({"world_size": 0}, "world_size = 0"),
        ({"communication_range": -1.0}, "communication_range = -1.0"),
        ({"failures": (Failure(4, 1.0),)}, "robot 4: must be from 0 to 3"),
        ({"failures": (Failure(1, 1.0), Failure(1, 2.0, 3.0))}, "robot 1 fails at 2.0 s, when"),
        ({"failures": tuple(Failure(i, 1.0) for i in range(4))}, "no robot is left at 1.0 s"),
        (
            {"failures": (Failure(1, 1.0),), "controller": "clairvoyant-cvt"},
            "must be lpac with failures",
        ),
        ({"loss": 0.1, "radio": ModelledRadio("mesh")}, "loss = 0.1, delay_s = 0.0: must be 0"),
        (
            {"radio": ModelledRadio("mesh"), "controller": "clairvoyant-cvt"},
            "must be lpac with a radio",
        ),
    ],
)
def test_impossible_scenarios_are_named(
    shipped_bundle: Bundle, change: dict[str, object], text: str
) -> None:
    with pytest.raises(ValueError, match=text):
        short(shipped_bundle, **change)


def test_an_impossible_failure_is_named() -> None:
    with pytest.raises(ValueError, match="robot 1: until_s = 2\\.0: must be after from_s = 2\\.0"):
        Failure(1, 2.0, 2.0)


@pytest.mark.parametrize("place", [(300.0, 180.0), (180.0, 300.0), (340.0, 256.0)])
def test_robots_go_to_the_important_side(
    shipped_bundle: Bundle, place: tuple[float, float]
) -> None:
    """One important place, whose edge the robots can see from the middle of the world."""
    feature = GaussianFeature(mean=place, sigma=(40.0, 40.0))
    starts_m = ((15.5, 15.5), (16.5, 16.5), (15.5, 16.5))
    flight = short(shipped_bundle, robots=3, starts_m=starts_m, features=(feature,))
    others = np.array([place[::-1], 512.0 - np.array(place)])
    to_place, *to_others = np.linalg.norm(
        flight.positions_m[-1] - np.array([place, *others])[:, None] / 16.0, axis=2
    ).mean(axis=1)
    assert to_place < min(to_others)


def test_a_baseline_that_is_wrong_about_its_place_ends_beside_its_goal(
    shipped_bundle: Bundle,
) -> None:
    feature = GaussianFeature(mean=(256.0, 256.0), sigma=(40.0, 40.0))
    [[x_m, y_m]] = short(
        shipped_bundle, robots=1, starts_m=((14.0, 18.0),), features=(feature,),
        controller="clairvoyant-cvt", position_bias=((16.0, -24.0),),
    ).positions_m[-1]  # fmt: skip
    assert (x_m, y_m) == pytest.approx((15.0, 17.5), abs=0.1)


def test_a_bundle_without_perception_cannot_fly(shipped_bundle: Bundle) -> None:
    manifest = dataclasses.replace(shipped_bundle.manifest, perception=None)
    blind = dataclasses.replace(shipped_bundle, manifest=manifest)
    with pytest.raises(BundleError, match="has no perception"):
        short(blind)
