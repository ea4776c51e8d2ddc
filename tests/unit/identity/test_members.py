"""The file with a fleet's members: whole, or not taken."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.identity.members import Member, Members, MembersError, Role, number_of, parse_members

ANN = Member(Role.OPERATOR, "ann@laptop", None, b"b" * 32)
R3 = Member(Role.ROBOT, "r3", 3, b"c" * 32)
LIST = Members("demo", 7, b"a" * 32, (ANN, R3))


def test_a_file_is_its_list_whatever_its_comments() -> None:
    assert parse_members(LIST.text) == LIST
    head, *lines = LIST.text.splitlines()
    commented = "\n".join(["# by hand", "", head, "# who commands", *lines, ""])
    assert parse_members(commented) == LIST
    assert LIST.robot_ids == {3} and LIST.by_key[R3.fingerprint] == R3


def test_the_digest_has_the_number_and_changes_with_every_member() -> None:
    assert number_of(LIST.digest) == 7 and len(LIST.digest) == 4
    others = [
        Members("demo", 8, b"a" * 32, (ANN, R3)),
        Members("demo", 7, b"a" * 32, (ANN,)),
        Members("demo", 7, b"a" * 32, (ANN, Member(Role.ROBOT, "r3", 4, b"c" * 32))),
    ]
    assert len({LIST.digest, *(other.digest for other in others)}) == 4


@given(st.integers(0, len(LIST.text) - 2))
def test_no_torn_file_is_a_list(length: int) -> None:
    with pytest.raises(MembersError):
        parse_members(LIST.text[:length])


@given(st.text() | st.binary().map(lambda data: LIST.text + data.decode("utf-8", "replace")))
def test_no_text_does_harm(text: str) -> None:
    try:
        assert parse_members(text).members == LIST.members
    except MembersError as error:
        assert "\n" not in str(error) and len(str(error)) < 500


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("robot", "pilot"), ("robot", "operator"), ("r3 3", "r3 -"), ("r3 3", "r3 70000"),
        ("r3 3", "r3"), (" 7 ", " 0 "), (" 7 ", " 65536 "), (" 7 ", " seven "), (" 2 ", " 3 "),
        ("63" * 32, "63" * 31), ("63" * 32, "zz" * 32), ("63" * 32, "62" * 32), ("fleet", "group"),
    ],
)  # fmt: skip
def test_a_malformed_list_gives_one_line(right: str, wrong: str) -> None:
    assert right in LIST.text
    with pytest.raises(MembersError, match="members: ") as raised:
        parse_members(LIST.text.replace(right, wrong))
    assert "\n" not in str(raised.value)


def test_one_place_and_one_key_have_one_member() -> None:
    with pytest.raises(MembersError, match="two have one place"):
        Members("demo", 1, b"a" * 32, (R3, Member(Role.ROBOT, "spare", 3, b"d" * 32)))
    with pytest.raises(MembersError, match="two have one key"):
        Members("demo", 1, b"a" * 32, (R3, Member(Role.ROBOT, "r4", 4, R3.public_key)))
    with pytest.raises(ValueError, match="robots alone must have one"):
        Member(Role.ROBOT, "r1", None, b"k" * 32)
