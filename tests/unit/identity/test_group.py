"""What goes to all robots at once: sealed, in pieces, and put together again or not at all."""

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.identity.envelope import HEAD_BYTES, enclose, is_of_other_version
from edge.identity.group import (
    DATAGRAM_BYTES,
    MOST_BYTES,
    PART_BYTES,
    Assembly,
    GroupKey,
    datagrams,
    frames,
    open_datagram,
    open_fleet_key,
)
from edge.identity.replay_window import NO_NUMBER, MessageNumber

KEY, FORMER, ANOTHER = (GroupKey.of(bytes([n]) * 32) for n in range(3))
numbers = st.builds(MessageNumber, st.integers(0, 2**48 - 1), st.integers(0, 2**32 - 1))
payloads = st.integers(0, MOST_BYTES - HEAD_BYTES).map(
    lambda size: bytes(n % 251 for n in range(size))
)


def sent(
    payload: bytes,
    sequence: int = 1,
    *,
    sender: int = 7,
    start: int = 1,
    key: GroupKey = KEY,
) -> list[bytes]:
    message = enclose(payload, MessageNumber(start, sequence))
    return datagrams(message, sender=sender, key=key)


def put_together(assembly: Assembly, pieces: Sequence[bytes], *, heard: bool = True) -> list[bytes]:
    """Payloads that came out."""
    payloads = []
    for piece in pieces:
        fragment = open_datagram(piece, (KEY, FORMER))
        assert fragment is not None
        message = assembly.add(fragment, 0.0)
        if message is not None:
            payloads.append(message[HEAD_BYTES:])
            if heard:
                assembly.confirm(fragment, 0.0)
    return payloads


@given(payloads, st.integers(0, 2**16 - 1), numbers, st.sampled_from([KEY, FORMER]), st.randoms())
def test_a_message_comes_out_as_it_went_in(
    payload: bytes, sender: int, number: MessageNumber, key: GroupKey, random: object
) -> None:
    message = enclose(payload, number)
    pieces = datagrams(message, sender=sender, key=key)
    assert len(pieces) == frames(len(message)) <= 3
    assert all(len(piece) <= DATAGRAM_BYTES for piece in pieces)
    random.shuffle(pieces)  # type: ignore[attr-defined]
    fragments = [open_datagram(piece, (KEY, FORMER)) for piece in pieces]
    for fragment in fragments:
        assert fragment is not None
        assert (fragment.sender, fragment.number) == (sender, number)
    assert put_together(Assembly(), pieces) == [payload]


def test_of_a_message_in_pieces_there_is_all_or_nothing() -> None:
    message = b"x" * (3 * PART_BYTES)
    for lost in range(3):
        pieces = sent(message)
        del pieces[lost]
        assert put_together(Assembly(), pieces) == []
    with pytest.raises(ValueError, match=f"a group takes {MOST_BYTES} at most"):
        sent(message + b"x")


@given(st.data())
def test_nobody_without_the_key_is_listened_to(data: st.DataObject) -> None:
    (piece,) = sent(b"hello")
    at = data.draw(st.integers(0, len(piece) - 1))
    changed = bytearray(piece)
    changed[at] ^= data.draw(st.integers(1, 255))
    assert open_datagram(bytes(changed), (KEY, FORMER)) is None
    assert open_datagram(piece[: data.draw(st.integers(0, len(piece) - 1))], (KEY,)) is None
    assert open_datagram(data.draw(st.binary(max_size=2000)), (KEY,)) is None
    assert open_datagram(piece, (FORMER, ANOTHER)) is None
    assert b"hello" not in piece


def test_replays_are_dropped() -> None:
    assembly = Assembly()
    first, second = sent(b"first", 1), sent(b"s" * 2000, 2)
    assert put_together(assembly, [*first, *second]) == [b"first", b"s" * 2000]
    # A stranger says it again, and what was lost on its way.
    assert put_together(assembly, [*second, *first, *second]) == []
    assert assembly.old == 5
    # A new start of its program counts from the beginning.
    assert put_together(assembly, sent(b"again", 0, start=2)) == [b"again"]


def test_what_was_not_its_senders_makes_nothing_old() -> None:
    assembly = Assembly()
    claimed = sent(b"not mine", 2**32 - 1, start=2**48 - 1)
    assert put_together(assembly, claimed, heard=False) == [b"not mine"]
    # And pieces of it, as many as it likes, keep nothing out but other pieces.
    for sequence in range(1000):
        put_together(assembly, sent(b"x" * 2000, sequence, start=5)[:1])
    assert put_together(assembly, sent(b"m" * 2000, 1)) == [b"m" * 2000]


def test_pieces_that_do_not_belong_to_a_message_do_not_spoil_it() -> None:
    """Whoever has a key, the former one too, may put a piece before each message."""
    assembly = Assembly()
    number = MessageNumber(1, 2)
    short, long, wrong = b"short", b"l" * 2000, b"w" * 3000
    for genuine in (short, long):
        for key in (KEY, FORMER):
            put_together(assembly, sent(wrong, number.sequence, key=key)[1:2])
        [message] = put_together(assembly, sent(genuine, number.sequence))
        assert message == genuine
        number = number._replace(sequence=number.sequence + 1)


def test_the_former_key_is_refused_after_a_sender_used_the_new_one() -> None:
    assembly = Assembly()
    assert put_together(assembly, sent(b"not yet", 1, key=FORMER)) == [b"not yet"]
    assert put_together(assembly, sent(b"stolen", 2, key=FORMER), heard=False) == [b"stolen"]
    assert put_together(assembly, sent(b"by now", 2)) == [b"by now"]
    assert put_together(assembly, sent(b"stolen", 3, key=FORMER)) == []
    # Of others nothing follows.
    assert put_together(assembly, sent(b"not yet", 1, sender=8, key=FORMER)) == [b"not yet"]


def test_a_member_with_a_thousand_names_deafens_nobody() -> None:
    assembly = Assembly()
    before = sent(b"before", 1)
    assert put_together(assembly, before) == [b"before"]
    for sender in range(1000, 3000):
        put_together(assembly, sent(b"me, too", sender=sender), heard=False)
    assert put_together(assembly, sent(b"m" * 2000, sender=8)) == [b"m" * 2000]
    # Who was heard is still known.
    assert put_together(assembly, before) == []


def test_an_open_fleets_robot_may_come_back_with_an_earlier_clock() -> None:
    def comes_through(assembly: Assembly, sequence: int, start: int, now_s: float) -> bool:
        fragment = open_datagram(sent(b"hello", sequence, start=start)[0], (KEY,))
        assert fragment is not None
        if assembly.add(fragment, now_s) is None:
            return False
        assembly.confirm(fragment, now_s)
        return True

    for forget_after_s, comes in ((5.0, True), (float("inf"), False)):
        assembly = Assembly(forget_after_s)
        assert comes_through(assembly, 1, start=2, now_s=0.0)
        assert not comes_through(assembly, 1, start=1, now_s=4.9)
        assert comes_through(assembly, 1, start=1, now_s=5.1) is comes


def test_of_an_envelope_of_another_version_the_sender_is_known() -> None:
    (datagram,) = datagrams(b"LE\xff" + bytes(HEAD_BYTES), sender=7, key=KEY)
    fragment = open_datagram(datagram, (KEY,))
    assert fragment is not None
    assert (fragment.sender, fragment.number) == (7, NO_NUMBER)
    assert is_of_other_version(fragment.head)


def test_what_has_no_envelope_does_not_come_through() -> None:
    for message in (b"", b"hello" * 40):
        (piece,) = datagrams(message, sender=7, key=KEY)
        assert open_datagram(piece, (KEY,)) is None


def test_a_key_is_32_bytes_and_fleets_without_keys_are_kept_apart() -> None:
    with pytest.raises(ValueError, match="a group key has 5 bytes: must be 32"):
        GroupKey.of(b"short")
    field, other = (GroupKey.of(open_fleet_key(fleet)) for fleet in ("field", "other"))
    assert open_datagram(sent(b"hello", key=field)[0], (other,)) is None
