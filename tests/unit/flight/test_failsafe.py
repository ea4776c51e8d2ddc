"""Failsafe: PX4's parameters are refused or explained as PX4 would act on them."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.flight.failsafe import PARAMETERS, RemoteControl, check, explain, required
from lpac.sim.px4 import modes
from lpac.sim.px4.parameters import PARAMETERS as PX4_DEFAULTS

KINDS: tuple[RemoteControl, ...] = ("pilot", "none")
values = st.none() | st.integers(-2, 130000) | st.floats(allow_nan=True, allow_infinity=True)


def safe(rc: RemoteControl) -> dict[str, int | float | None]:
    settings = {r.name: r.value_to_set for r in required(rc, 25.0) if r.value_to_set is not None}
    return {**PX4_DEFAULTS, **settings}


def line(about: str, parameters: dict[str, int | float | None]) -> str:
    (found,) = (text for text in explain(parameters) if about in text)
    return found


@pytest.mark.parametrize("rc", KINDS)
def test_what_is_set_is_safe(rc: RemoteControl) -> None:
    parameters = safe(rc)
    assert check(required(rc, 25.0), parameters) == ()
    assert not any(
        "RETURN" in text or "STOP" in text or "NOT" in text for text in explain(safe(rc))
    )
    assert line("program dies", parameters).endswith(
        "land where it is, 1 s after the last command; it obeys again when commands come"
    )


@pytest.mark.parametrize("rc", KINDS)
def test_what_is_required_can_be_set_and_is_read(rc: RemoteControl) -> None:
    for requirement in required(rc, 25.0):
        assert requirement.name in PARAMETERS
        assert len(requirement.name) <= 16  # MAVLink's limit
        assert requirement.value_to_set is None or requirement.allows(requirement.value_to_set)
        if requirement.name in PX4_DEFAULTS and requirement.value_to_set is not None:
            assert type(requirement.value_to_set) is type(PX4_DEFAULTS[requirement.name])


@pytest.mark.parametrize("rc", KINDS)
@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("COM_OF_LOSS_T", 0.5, "COM_OF_LOSS_T = 0.5; wanted is above 0.7 and up to 1.5"),
        ("COM_OF_LOSS_T", 2.0, "COM_OF_LOSS_T = 2"),
        ("COM_OBL_RC_ACT", 5, "COM_OBL_RC_ACT = 5 (hold where it is); wanted is 4"),
        ("COM_OBL_RC_ACT", 3, "COM_OBL_RC_ACT = 3 (RETURN to where it was armed"),
        ("COM_OBL_RC_ACT", 7, "COM_OBL_RC_ACT = 7 (STOP ITS MOTORS and fall)"),
        ("COM_FAIL_ACT_T", 25.0, "COM_FAIL_ACT_T = 25"),
        ("NAV_RCL_ACT", 2, "NAV_RCL_ACT = 2 (RETURN"),
        ("COM_RC_IN_MODE", 3, "COM_RC_IN_MODE = 3 (whoever moves sticks first"),
        ("NAV_DLL_ACT", 3, "NAV_DLL_ACT = 3 (land); wanted is 0 (do nothing)"),
        ("GF_ACTION", 4, "GF_ACTION = 4 (STOP ITS MOTORS"),
        ("GF_MAX_HOR_DIST", 30.0, "GF_MAX_HOR_DIST = 30; wanted is 0 (off)"),
        ("GF_MAX_VER_DIST", 26.0, "GF_MAX_VER_DIST = 26; wanted is 0 (off) or above 27"),
        ("COM_LOW_BAT_ACT", 3, "COM_LOW_BAT_ACT = 3 (RETURN"),
        ("BAT_CRIT_THR", 0.2, "PX4 would warn after it acts"),
        ("COM_FLTT_LOW_ACT", 3, "COM_FLTT_LOW_ACT = 3 (RETURN"),
        ("COM_ACT_FAIL_ACT", 3, "COM_ACT_FAIL_ACT = 3 (RETURN"),
        ("COM_ACT_FAIL_ACT", 4, "COM_ACT_FAIL_ACT = 4 (STOP ITS MOTORS"),
        ("COM_IMB_PROP_ACT", 1, "COM_IMB_PROP_ACT = 1 (RETURN"),
        ("NAV_TRAFF_AVOID", 2, "NAV_TRAFF_AVOID = 2 (RETURN"),
        ("COM_RC_IN_MODE", 5, "COM_RC_IN_MODE = 5 (the remote control's sticks count, or a"),
        ("COM_RC_IN_MODE", 6, "COM_RC_IN_MODE = 6 (a ground station's sticks count (the first"),
        ("COM_RC_IN_MODE", 7, "COM_RC_IN_MODE = 7 (the remote control's sticks count, or a"),
        ("COM_RC_IN_MODE", 8, "COM_RC_IN_MODE = 8 (a ground station's sticks count (the second"),
        ("COM_FLT_TIME_MAX", 600, "COM_FLT_TIME_MAX = 600; wanted is -1 (never)"),
        ("COM_DISARM_LAND", 0.0, "COM_DISARM_LAND = 0"),
        ("COM_DISARM_LAND", 0.5, "COM_DISARM_LAND = 0.5; wanted is above 0.5"),
        ("COM_DISARM_PRFLT", -1.0, "COM_DISARM_PRFLT = -1"),
        ("COM_ARM_ON_BOOT", 1, "COM_ARM_ON_BOOT = 1 (PX4 arms by itself after power-up)"),
        ("CBRK_FLIGHTTERM", 0, "CBRK_FLIGHTTERM = 0; wanted is 121212"),
        ("EKF2_HGT_REF", 3, "EKF2_HGT_REF = 3 (vision)"),
    ],
)
def test_an_unsafe_value_is_named_with_what_it_does_and_what_is_wanted(
    rc: RemoteControl, name: str, value: float, said: str
) -> None:
    (problem,) = check(required(rc, 25.0), {**safe(rc), name: value})
    assert said in problem
    assert "\n" not in problem


def test_a_pilot_must_be_able_to_take_over_and_nobody_must_not() -> None:
    with_pilot = required("pilot", 25.0)
    problems = check(with_pilot, {**safe("pilot"), "COM_RC_OVERRIDE": 1, "COM_RCL_EXCEPT": 0})
    assert [text.split(" ")[0] for text in problems] == ["COM_RCL_EXCEPT", "COM_RC_OVERRIDE"]
    assert "not from offboard mode" in problems[1]
    (problem,) = check(with_pilot, {**safe("pilot"), "COM_RC_IN_MODE": 4})
    assert "COM_RC_IN_MODE = 4 (no sticks count)" in problem
    (problem,) = check(required("none", 25.0), {**safe("none"), "COM_RC_IN_MODE": 0})
    assert "nobody has a remote control" in problem


def test_a_parameter_that_the_vehicle_does_not_have_is_a_problem_unless_it_is_newer() -> None:
    requirements = required("pilot", 25.0)
    problems = check(requirements, {})
    optional = {
        "COM_POS_LOW_ACT", "COM_WIND_MAX_ACT", "COM_FLTT_LOW_ACT", "COM_FLT_TIME_MAX",
        "COM_ARM_ON_BOOT", "NAV_TRAFF_AVOID",
    }  # fmt: skip
    assert {text.split(" ")[0] for text in problems} == set(PARAMETERS) - optional
    assert all("is not known" in text for text in problems)
    assert any("NOT KNOWN" in text for text in explain({}))


def test_values_as_32_bit_floats_are_allowed() -> None:
    requirements = required("pilot", 25.0)
    parameters = {**safe("pilot"), "BAT_CRIT_THR": 0.4000000059604645, "BAT_LOW_THR": 0.45}
    assert check(requirements, parameters) == ()


@given(st.dictionaries(st.sampled_from(PARAMETERS), values))
def test_any_values_are_explained_and_each_unsafe_one_is_named(
    change: dict[str, int | float | None],
) -> None:
    requirements = required("pilot", 25.0)
    parameters = {**safe("pilot"), **change}
    problems = check(requirements, parameters)
    for requirement in requirements:
        value = parameters.get(requirement.name)
        is_bad = not requirement.may_be_absent if value is None else not requirement.allows(value)
        named = any(text.startswith(f"{requirement.name} ") for text in problems)
        assert named == is_bad or "BAT_" in requirement.name
    assert all("\n" not in text for text in (*problems, *explain(parameters)))


def test_defaults_of_px4_are_explained_as_they_were_flown() -> None:
    parameters: dict[str, int | float | None] = dict(PX4_DEFAULTS)
    for sticks in (0, 1, 2):
        handed_over = {**parameters, "COM_OBL_RC_ACT": sticks}
        assert "without a remote control RETURN" in line("program dies", handed_over)
    nothing = {**parameters, "NAV_RCL_ACT": 0}
    assert "fly on with the last command: NO FAILSAFE" in line("program dies", nothing)
    assert "hold for 5 s, then RETURN" in line("remote control is lost", parameters)
    assert "fly until it falls" in line("battery", parameters)
    assert "not from offboard mode" in line("moves the sticks", parameters)


WORDS = {
    modes.FailsafeAction.HOLD: "hold",
    modes.FailsafeAction.RETURN: "RETURN",
    modes.FailsafeAction.LAND: "land",
    modes.FailsafeAction.STOP_MOTORS: "STOP ITS MOTORS",
    modes.FailsafeAction.WARN: "warn",
}


@pytest.mark.parametrize(
    ("name", "about", "actions"),
    [
        ("COM_OBL_RC_ACT", "program dies", modes.OFFBOARD_LOSS_ACTIONS),
        ("NAV_RCL_ACT", "remote control is lost", modes.LINK_LOSS_ACTIONS),
        ("NAV_DLL_ACT", "ground station", modes.LINK_LOSS_ACTIONS),
        ("GF_ACTION", "outside PX4's own fence", modes.FENCE_ACTIONS),
    ],
)
def test_the_simulated_vehicle_acts_as_explained(
    name: str, about: str, actions: dict[int, modes.FailsafeAction]
) -> None:
    for value, action in actions.items():
        parameters = {**safe("pilot"), name: value, "COM_FAIL_ACT_T": 0.0, "COM_RCL_EXCEPT": 0}
        assert WORDS[action] in line(about, parameters)
    assert "NOT KNOWN" in line(about, {**safe("pilot"), name: 77})


def test_what_else_is_dangerous_is_said_where_it_applies() -> None:
    dangers = {
        "CBRK_FLIGHTTERM": (0, "takes the vehicle for lost, it will: STOP"),
        "COM_FLT_TIME_MAX": (600, "after 600 s of flight, PX4 will: RETURN"),
        "COM_ARM_ON_BOOT": (1, "ARM BY ITSELF"),
        "COM_FLTT_LOW_ACT": (3, "RETURN"),
        "COM_ACT_FAIL_ACT": (3, "and PX4 notices, it will: hold for 5 s, then RETURN"),
        "COM_IMB_PROP_ACT": (1, "shakes the vehicle, PX4 will: hold for 5 s, then RETURN"),
        "NAV_TRAFF_AVOID": (2, "by an ADS-B receiver, PX4 will: RETURN"),
        "GF_MAX_VER_DIST": (30.0, "the same 30 m above"),
        "GF_MAX_HOR_DIST": (40.0, "the same 40 m away from"),
    }
    assert "the same" not in " ".join(explain(safe("pilot")))
    for name, (value, said) in dangers.items():
        assert said not in " ".join(explain(safe("pilot")))
        assert said in " ".join(explain({**safe("pilot"), name: value}))


def test_arguments_that_make_no_sense_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="rc = 'both': allowed are 'pilot', 'none'"):
        required("both", 25.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="ceiling_m = nan"):
        required("pilot", math.nan)
    for timeout_s in (0.2, 1.1, math.nan):
        with pytest.raises(ValueError, match=f"command_timeout_s = {timeout_s}"):
            required("pilot", 25.0, timeout_s)
