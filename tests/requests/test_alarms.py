"""Whose crash reports are believed: laws of `Alarms`, on its own clock."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from fogft.requests.alarms import ALARM_S, FALSE_ALARMS, LATELY_S, Alarms

LIAR, OTHER = 0, 1


def cried(alarms: Alarms, count: int, began_at: float = 0.0) -> float:
    """Have the liar report so many deaths, all of them false; return when the last one was."""
    at = began_at
    for number in range(count):
        at = began_at + number * ALARM_S
        alarms.believed(LIAR, at)
        alarms.was_false(LIAR, at)
    return at


def test_each_is_believed_until_it_has_been_wrong_too_often():
    alarms = Alarms()
    last = cried(alarms, FALSE_ALARMS - 1)
    assert alarms.believed(LIAR, last + ALARM_S)
    alarms.was_false(LIAR, last + ALARM_S)
    assert not alarms.believed(LIAR, last + 2 * ALARM_S)
    assert alarms.believed(OTHER, last + 2 * ALARM_S), "nobody else is blamed"


def test_a_false_alarm_is_forgotten_after_a_while_and_not_sooner():
    alarms = Alarms()
    last = cried(alarms, FALSE_ALARMS)
    first = last - (FALSE_ALARMS - 1) * ALARM_S
    assert not alarms.believed(LIAR, first + LATELY_S - 0.01)
    assert alarms.believed(LIAR, first + LATELY_S)
    alarms.was_false(LIAR, first + LATELY_S)
    assert not alarms.believed(LIAR, first + LATELY_S + ALARM_S / 2), "only one was forgotten"


def test_what_is_said_within_a_moment_counts_once_and_after_it_again():
    """The moment counts from the first word: words that never stop are more than one alarm."""
    for apart_s, believed in ((0.9 * ALARM_S / 3, True), (ALARM_S, False)):
        alarms = Alarms()
        for number in range(FALSE_ALARMS):
            alarms.believed(LIAR, number * apart_s)
            alarms.was_false(LIAR, number * apart_s)
        assert alarms.believed(LIAR, FALSE_ALARMS * apart_s) is believed
    alarms = Alarms()
    for tenth in range(10 * FALSE_ALARMS):
        alarms.believed(LIAR, tenth * ALARM_S / 10)
        alarms.was_false(LIAR, tenth * ALARM_S / 10)
    assert not alarms.believed(LIAR, FALSE_ALARMS * ALARM_S)


def test_who_was_right_begins_anew():
    alarms = Alarms()
    last = cried(alarms, FALSE_ALARMS)
    alarms.were_right([OTHER])
    assert not alarms.believed(LIAR, last + ALARM_S)
    alarms.were_right([LIAR, OTHER])
    assert alarms.believed(LIAR, last + ALARM_S)


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.floats(0, 2 * ALARM_S), st.booleans(), st.booleans()),
        max_size=40,
    )
)
def test_who_was_never_wrong_is_always_believed(said):
    """Whatever the others say, when, and whether they were right."""
    alarms, now = Alarms(), 0.0
    for replica, pause_s, was_false, were_right in said:
        now += pause_s
        believed = alarms.believed(replica, now)
        assert believed or replica != 2
        if was_false and replica != 2:
            alarms.was_false(replica, now)
        if were_right:
            alarms.were_right([replica])
            assert alarms.believed(replica, now)


quarters = st.integers(0, int(4 * LATELY_S / FALSE_ALARMS)).map(lambda count: count / 4)


@given(st.lists(quarters, min_size=FALSE_ALARMS, max_size=30))
def test_who_is_wrong_often_enough_is_not_believed_whatever_the_pace(pauses_s):
    """Of false alarms that are each at least a moment apart, all but the first few are vain."""
    alarms, now, false = Alarms(), 0.0, list[float]()
    for pause_s in pauses_s:
        now += ALARM_S + pause_s
        lately = [at for at in false if now - at < LATELY_S]
        assert alarms.believed(LIAR, now) is (len(lately) < FALSE_ALARMS)
        alarms.was_false(LIAR, now)
        false.append(now)
