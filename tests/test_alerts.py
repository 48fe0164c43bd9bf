"""The life of alerts, by hand and as a state machine: raised once, cleared once, nothing said twice."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from gripmon.judge.policy import AlertBook
from gripmon.model.records import Alert, AlertEvent, AlertKind, Cause, Severity

UPDATE_S, CLEAR_S = 2.0, 1.0
TOPICS = ("motion", "view", "stream:clock")
RANK = [Severity.INFO, Severity.WARNING, Severity.ERROR]


def alert(
    severity: Severity = Severity.WARNING,
    cause: Cause = Cause.UNKNOWN,
    kind: AlertKind = AlertKind.STEP,
    x_m: float = 1e-3,
    rate_m_per_min: float | None = None,
) -> Alert:
    return Alert(kind, cause, severity, "text", tcp_shift_m=(x_m, 0.0, 0.0), rate_m_per_min=rate_m_per_min)


class Told:
    """A book, and the time that passes."""

    def __init__(self) -> None:
        self.book, self.now_s = AlertBook(UPDATE_S, CLEAR_S), 0.0

    def present(self, what: Alert, after_s: float = 0.1, topic: str = "motion") -> tuple[Alert, ...]:
        self.now_s += after_s
        return self.book.present(topic, what, self.now_s, round(1e9 * self.now_s))

    def absent(self, after_s: float = 0.1, topic: str = "motion", *, at_once: bool = False) -> tuple[Alert, ...]:
        self.now_s += after_s
        return self.book.absent(topic, "over", self.now_s, at_once=at_once)


def test_cleared_when_absent_for_long_enough_without_a_break():
    told = Told()
    [raised] = told.present(alert(Severity.ERROR))
    assert [told.absent(0.4) for _ in range(3)] == [(), (), ()]
    assert told.present(alert(Severity.ERROR)) == ()
    assert [told.absent(0.4) for _ in range(3)] == [(), (), ()]
    [cleared] = told.absent(0.4)
    assert (cleared.event, cleared.severity, cleared.text) == (AlertEvent.CLEARED, Severity.INFO, "over")
    assert (cleared.alert_id, cleared.kind, cleared.since_ns) == (raised.alert_id, raised.kind, raised.since_ns)
    assert told.absent(5.0) == ()
    [again] = told.present(alert())
    assert again.event is AlertEvent.RAISED
    assert again.alert_id != raised.alert_id


@pytest.mark.parametrize(
    "change",
    [
        {"x_m": 1.6e-3},
        {"x_m": 0.6e-3},
        {"kind": AlertKind.CREEP},
        {"severity": Severity.INFO},
        {"rate_m_per_min": 1e-3},
    ],
)
def test_what_changes_is_updated_but_not_too_often(change: dict[str, object]):
    told = Told()
    [raised] = told.present(alert())
    changed = alert(**change)  # type: ignore[arg-type]
    for _ in range(19):
        assert told.present(changed) == ()
    [updated] = told.present(changed, after_s=0.2)
    assert (updated.event, updated.alert_id, updated.since_ns) == (
        AlertEvent.UPDATED,
        raised.alert_id,
        raised.since_ns,
    )
    assert told.present(changed, after_s=10.0) == (), "nothing new since"


@pytest.mark.parametrize("x_m", [0.7e-3, 1.45e-3])
def test_what_hardly_changes_is_not_updated(x_m: float):
    told = Told()
    told.present(alert())
    assert told.present(alert(x_m=x_m), after_s=60.0) == ()


def test_worse_and_a_cause_found_are_said_at_once():
    told = Told()
    told.present(alert(Severity.INFO))
    [worse] = told.present(alert(Severity.ERROR))
    assert (worse.event, worse.severity) == (AlertEvent.UPDATED, Severity.ERROR)
    [explained] = told.present(alert(Severity.ERROR, Cause.CAMERA_MOUNT))
    assert (explained.event, explained.cause) == (AlertEvent.UPDATED, Cause.CAMERA_MOUNT)
    assert told.present(alert(Severity.ERROR, Cause.FINGER_BENT)) == (), "another cause can wait"
    assert [a.cause for a in told.present(alert(Severity.ERROR, Cause.FINGER_BENT), UPDATE_S)] == [Cause.FINGER_BENT]


def test_acknowledged_by_id_or_all():
    told = Told()
    [one] = told.present(alert(), topic="motion")
    [other] = told.present(alert(), topic="view")
    assert told.book.acknowledge("nonsense") == ()
    [seen] = told.book.acknowledge(one.alert_id)
    assert (seen.alert_id, seen.event, seen.acknowledged) == (one.alert_id, AlertEvent.UPDATED, True)
    assert told.book.acknowledge(one.alert_id) == (), "only once"
    assert [a.alert_id for a in told.book.acknowledge()] == [other.alert_id]
    assert told.present(alert(x_m=5e-3), after_s=60.0) == (), "no more updates"
    [worse] = told.present(alert(Severity.ERROR))
    assert not worse.acknowledged, "worse than what was acknowledged"


def test_what_is_acknowledged_while_it_is_over_is_cleared_no_later():
    told = Told()
    told.present(alert())
    assert told.absent() == ()
    assert len(told.book.acknowledge()) == 1
    assert [a.event for a in told.absent(CLEAR_S)] == [AlertEvent.CLEARED]


def test_ids_differ_though_the_numbering_was_lost():
    ids = [AlertBook(1.0, 1.0).present("motion", alert(), 0.0, stamp_ns)[0].alert_id for stamp_ns in (1, 2, 3)]
    assert len(set(ids)) == 3


def test_changes_count_what_has_to_be_kept():
    told = Told()
    counts = [told.book.changes]
    for do in (
        lambda: told.present(alert()),
        lambda: told.present(alert(Severity.ERROR)),
        lambda: told.book.acknowledge(),
        lambda: told.absent(at_once=True),
    ):
        do()
        counts.append(told.book.changes)
    assert counts == sorted(set(counts)), "each of them is one"
    told.present(alert())
    before = told.book.changes
    told.present(alert())
    told.absent()
    assert told.book.changes == before


class LifeOfAlerts(RuleBasedStateMachine):
    """Whatever is seen in whatever order, listeners can keep the list of open alerts from the events alone."""

    def __init__(self) -> None:
        super().__init__()
        self.book, self.now_s = AlertBook(UPDATE_S, CLEAR_S), 0.0
        self.alive: dict[str, Alert] = {}
        self.dead: set[str] = set()
        self.said_s: dict[str, float] = {}
        self.absent_since_s: dict[str, float] = {}

    def hear(self, alerts: tuple[Alert, ...]) -> None:
        for each in alerts:
            assert each.alert_id not in self.dead
            known = self.alive.get(each.alert_id)
            assert (known is None) == (each.event is AlertEvent.RAISED)
            if known is not None:
                assert each.since_ns == known.since_ns
            if each.event is AlertEvent.UPDATED and known is not None and not each.acknowledged:
                worse = RANK.index(each.severity) > RANK.index(known.severity)
                explained = known.cause is Cause.UNKNOWN and each.cause is not Cause.UNKNOWN
                assert worse or explained or self.now_s - self.said_s[each.alert_id] >= UPDATE_S
                assert worse or not known.acknowledged
            if each.event is AlertEvent.CLEARED:
                del self.alive[each.alert_id]
                self.dead.add(each.alert_id)
            else:
                self.alive[each.alert_id] = each
                self.said_s[each.alert_id] = self.now_s

    @rule(step_s=st.sampled_from([0.01, 0.1, 0.5, 1.0, 3.0]))
    def time_passes(self, step_s: float) -> None:
        self.now_s += step_s

    @rule(
        topic=st.sampled_from(TOPICS),
        severity=st.sampled_from(RANK),
        cause=st.sampled_from([Cause.UNKNOWN, Cause.CAMERA_MOUNT, Cause.FINGER_BENT]),
        kind=st.sampled_from([AlertKind.STEP, AlertKind.CREEP]),
        x_m=st.sampled_from([0.0, 1e-4, 1e-3]),
    )
    def seen(self, topic: str, severity: Severity, cause: Cause, kind: AlertKind, x_m: float) -> None:
        self.absent_since_s.pop(topic, None)
        said = self.book.present(topic, alert(severity, cause, kind, x_m), self.now_s, round(1e9 * self.now_s))
        assert len(said) <= 1
        self.hear(said)
        assert self.book.about(topic) is not None

    @rule(topic=st.sampled_from(TOPICS), at_once=st.booleans())
    def gone(self, topic: str, at_once: bool) -> None:
        was_open = self.book.about(topic) is not None
        since_s = self.absent_since_s.setdefault(topic, self.now_s)
        said = self.book.absent(topic, "over", self.now_s, at_once=at_once)
        cleared = was_open and (at_once or self.now_s - since_s >= CLEAR_S)
        assert [a.event for a in said] == [AlertEvent.CLEARED] * cleared
        self.hear(said)
        if cleared:
            self.absent_since_s.pop(topic)

    @rule(data=st.data())
    def acknowledged(self, data: st.DataObject) -> None:
        which = data.draw(st.sampled_from(["", *sorted(self.alive), *sorted(self.dead)]))
        said = self.book.acknowledge(which)
        assert all(a.acknowledged and a.alert_id in self.alive for a in said)
        due = {i for i, a in self.alive.items() if not a.acknowledged and which in ("", i)}
        assert {a.alert_id for a in said} == due
        # What was said when, is of what is seen only.
        for each in said:
            self.alive[each.alert_id] = each

    @rule()
    def restarted(self) -> None:
        book = AlertBook(UPDATE_S, CLEAR_S)
        book.restore(self.book.open, self.book.raised, self.now_s)
        self.book = book
        self.said_s = dict.fromkeys(self.alive, self.now_s)
        self.absent_since_s.clear()

    @invariant()
    def listeners_know_what_is_open(self) -> None:
        assert {each.alert.alert_id: each.alert for each in self.book.open} == self.alive


TestLifeOfAlerts = LifeOfAlerts.TestCase
TestLifeOfAlerts.settings = settings(max_examples=60, stateful_step_count=60)
