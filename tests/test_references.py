"""The chain of references: what each command does to it, and what it refuses without a change."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gripmon.judge.references import KEPT_REFERENCES, CommandRefused, ReferenceBook, chain_fault, state_fault
from gripmon.model.records import Cause, MonitorState, ReferenceInputs, ReferenceRecord, Transform

COVARIANCE = np.diag([1e-10, 2e-10, 9e-10, 1e-8, 2e-8, 3e-8])
INPUTS = ReferenceInputs(10, 40, 31, ("L_in_near",), 0.98, 0.0045, 0.002)


def pose(i: int) -> np.ndarray:
    """(4, 4), another one for each number."""
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec([0.5, 0.01 * i, 0.0]).as_matrix()
    out[:3, 3] = [0.001 * i, 0.002, 0.12]
    return out


def configured(revision: int = 0) -> ReferenceRecord:
    transform = Transform((0.0, 0.002, 0.12), (0.0, 0.0, 0.0, 1.0))
    return ReferenceRecord("factory", revision, 5, "configuration", transform, tuple(COVARIANCE.ravel().tolist()))


def adopt(book: ReferenceBook, i: int) -> ReferenceRecord:
    return book.adopt(book.draft(pose(i), COVARIANCE, 1000 + i, cause=Cause.CAMERA_MOUNT, inputs=INPUTS))


def propose(book: ReferenceBook, i: int) -> ReferenceRecord:
    draft = book.draft(pose(i), COVARIANCE, 1000 + i)
    book.propose(draft)
    return draft


def book_of(*steps: str) -> ReferenceBook:
    """``a``: adopts a new pose, ``p``: proposes one, ``u``: undo, ``u3``: undo to the reference of revision 3, ``r``:
    reset, ``y`` and ``n``: accept and reject."""
    book = ReferenceBook(configured())
    for i, step in enumerate(steps, start=1):
        take(book, step, i)
    return book


def take(book: ReferenceBook, step: str, i: int) -> None:
    if step == "a":
        adopt(book, i)
    elif step == "p":
        propose(book, i)
    elif step == "y":
        book.accept()
    elif step == "n":
        book.reject()
    elif step == "r":
        book.reset(2000 + i)
    else:
        target = "" if step == "u" else named(book, int(step[1:]))
        book.undo(2000 + i, target)


def named(book: ReferenceBook, revision: int) -> str:
    return next((r.reference_id for r in book.history if r.revision == revision), f"revision-{revision}")


def pose_number(book: ReferenceBook) -> int:
    """Which pose is in force: 0 the configured one, else the step that brought it."""
    return round(1000.0 * book.current.cam_T_grip.translation_m[0])


@pytest.mark.parametrize(
    ("steps", "revision", "number"),
    [
        ("", 0, 0),
        ("a", 1, 1),
        ("a a", 2, 2),
        ("a p", 1, 1),
        ("a p y", 2, 2),
        ("a p n", 1, 1),
        ("a p p y", 2, 3),
        ("a a u", 3, 1),
        ("a a u u", 4, 0),
        ("a a u u2", 4, 2),  # what was undone comes back
        ("a a u a u", 5, 1),  # before the third pose came the first, which an undo had brought back
        ("a a u a u u", 6, 0),
        ("a a a u1", 4, 1),
        ("a a a u1 u", 5, 0),
        ("a a r", 3, 0),
        ("a a r u2", 4, 2),
        ("a a r a u", 5, 0),
        ("a a r u1", 4, 1),
    ],
)
def test_what_is_in_force_after(steps: str, revision: int, number: int):
    book = ReferenceBook(configured())
    for i, step in enumerate(steps.split(), start=1):
        take(book, step, i)
    assert (book.current.revision, pose_number(book)) == (revision, number)
    assert [r.revision for r in book.history] == list(range(revision + 1))


@pytest.mark.parametrize(
    ("steps", "refused", "reason"),
    [
        ("", "u", "factory is the first reference; there is none before it"),
        ("", "r", "factory is in force already, as revision 0"),
        ("", "y", "no new reference is proposed"),
        ("", "n", "no new reference is proposed"),
        ("a", "u7", "there is no reference revision-7 among the 2 known"),
        ("a u", "u", "factory is the first reference"),
        ("a u", "r", "factory is in force already, as revision 2"),
        ("a u", "u0", "factory is in force already, as revision 2"),
        ("a", "u1", "is in force already, as revision 1"),
        ("a a u", "u3", "is in force already, as revision 3"),
        ("a p n", "y", "no new reference is proposed"),
        ("a p y", "y", "no new reference is proposed"),
        ("a p u", "y", "no new reference is proposed"),  # it was made against what is no longer in force
        ("a p a", "y", "no new reference is proposed"),
    ],
)
def test_what_is_refused_changes_nothing(steps: str, refused: str, reason: str):
    book = book_of(*steps.split())
    before = (book.history, book.proposal, book.changes)
    with pytest.raises(CommandRefused, match=reason):
        take(book, refused, 99)
    assert (book.history, book.proposal, book.changes) == before


def test_only_the_proposal_that_is_meant_is_accepted_or_rejected():
    book = book_of("a", "p")
    first = book.proposal
    second = propose(book, 3)
    assert first is not None and book.proposal == second and first.reference_id != second.reference_id
    for command in (book.accept, book.reject):
        with pytest.raises(CommandRefused, match=f"{first.reference_id} is not proposed; {second.reference_id} is"):
            command(first.reference_id)
    assert book.accept(second.reference_id).accepted_by == "operator"
    assert book.current.reference_id == second.reference_id and book.proposal is None


def test_every_reference_says_where_it_came_from():
    book = book_of("a", "p", "y", "u")
    first, second, third = book.history[1:]
    assert (first.origin, first.accepted_by, first.parent, first.cause, first.inputs, first.stamp_ns) == (
        "recalibration", "monitor", "factory", Cause.CAMERA_MOUNT, INPUTS, 1001,
    )  # fmt: skip
    np.testing.assert_array_equal(np.reshape(first.covariance, (6, 6)), COVARIANCE)
    assert (second.accepted_by, second.parent, second.restores) == ("operator", first.reference_id, None)
    assert (third.origin, third.accepted_by, third.stamp_ns) == ("undo", "operator", 2004)
    assert (third.parent, third.restores) == (second.reference_id, first.reference_id)
    assert (third.cam_T_grip, third.covariance) == (first.cam_T_grip, first.covariance)
    assert third.reference_id != first.reference_id
    assert book.chosen_by_operator and not book_of("a").chosen_by_operator


def test_a_draft_for_another_revision_is_an_error():
    book = book_of("a")
    late = book.draft(pose(2), COVARIANCE, 5)
    adopt(book, 3)
    for take_it in (book.adopt, book.propose):
        with pytest.raises(ValueError, match="revision 2 follows revision 2"):
            take_it(late)
    ahead = msgspec.structs.replace(book.draft(pose(2), COVARIANCE, 5), revision=9)
    with pytest.raises(ValueError, match="revision 9 follows revision 2"):
        book.adopt(ahead)


@pytest.mark.parametrize(
    "bad",
    [
        -COVARIANCE,
        np.zeros((6, 6)),
        COVARIANCE + 1e-10 * np.eye(6, k=1),
        np.full((6, 6), np.nan),
        1e-9 * (2.0 * np.ones((6, 6)) - np.eye(6)),
    ],
)
def test_a_draft_without_a_covariance_never_comes_in_force(bad: np.ndarray):
    book = book_of("a")
    with pytest.raises(ValueError, match="no covariance"):
        book.adopt(book.draft(pose(2), bad, 5))
    assert book.current.revision == 1


def test_a_draft_that_is_no_pose_never_comes_in_force():
    book, wrong = book_of("a"), pose(2)
    wrong[0, 3] = np.nan
    with pytest.raises(ValueError, match="no pose"):
        book.propose(book.draft(wrong, COVARIANCE, 5))
    assert book.proposal is None


STEPS = st.lists(st.sampled_from(["a", "p", "y", "n", "u", "r", "u0", "u1", "u2", "u5"]), max_size=40)


@settings(max_examples=200)
@given(STEPS)
def test_whatever_is_asked_the_chain_holds_together_and_can_be_kept(steps: list[str]):
    book, names = ReferenceBook(configured(3)), {}
    for i, step in enumerate(steps):
        try:
            take(book, step, i)
        except CommandRefused:
            continue
        for reference in book.history:
            assert names.setdefault(reference.revision, reference.reference_id) == reference.reference_id
        if step[0] in "ur":
            (earlier,) = [r for r in book.history if r.reference_id == book.current.restores]
            assert (earlier.cam_T_grip, earlier.restores) == (book.current.cam_T_grip, None)
    assert chain_fault(book.history, book.proposal) == ""
    kept = MonitorState(book.history, book.proposal)
    back = msgspec.json.decode(msgspec.json.encode(kept), type=MonitorState)
    again = ReferenceBook.restored(back.references, back.proposal)
    assert (again.history, again.proposal) == (book.history, book.proposal)
    assert again.draft(pose(1), COVARIANCE, 1) == book.draft(pose(1), COVARIANCE, 1)


def test_thousands_of_references_keep_the_first_and_the_newest():
    book = ReferenceBook(configured())
    for i in range(KEPT_REFERENCES + 50):
        adopt(book, i % 7)
    assert len(book.history) == KEPT_REFERENCES and book.history[0] == configured()
    assert [r.revision for r in book.history[1:]] == list(range(52, KEPT_REFERENCES + 51))
    assert chain_fault(book.history) == ""
    gone = book.history[1].parent
    assert gone is not None
    with pytest.raises(CommandRefused, match=f"there is no reference {gone}"):
        book.undo(1, gone)
    book.undo(1, book.history[2].reference_id)  # now the oldest of those that are kept is dropped
    with pytest.raises(CommandRefused, match="too long ago and no longer kept; reset"):
        book.undo(2)
    book.reset(3)
    assert book.current.cam_T_grip == configured().cam_T_grip and chain_fault(book.history) == ""
    ReferenceBook.restored(book.history)


def broken(what: str) -> MonitorState:
    """A state with one fault."""
    book = book_of("a", "a", "u")
    propose(book, 9)
    first, second, third, fourth = book.history
    change = msgspec.structs.replace
    references = {
        "nothing": (),
        "swapped": (first, third, second, fourth),
        "missing": (first, second, fourth),
        "twice": (first, second, second),
        "parent": (first, second, change(third, parent="factory"), fourth),
        "no parent": (first, second, change(third, parent=None), fourth),
        "restores": (first, second, third, change(fourth, restores="never-was")),
        "restores itself": (first, second, third, change(fourth, restores=fourth.reference_id)),
        "negative": (
            change(first, revision=-1),
            *(change(r, revision=r.revision - 1) for r in (second, third, fourth)),
        ),
        "short": (first, second, change(third, covariance=third.covariance[:35]), fourth),
        "turned": (first, second, change(third, cam_T_grip=Transform((0, 0, 0.1), (0.1, 0.2, 0.3, 0.4))), fourth),
        "far": (first, second, change(third, cam_T_grip=Transform((0, 0, 1e999), (0, 0, 0, 1))), fourth),
    }.get(what, book.history)
    proposal = book.proposal if what in ("proposal", "last") else None
    if what == "proposal":
        proposal = change(book.proposal, revision=9)
    last = Transform((0, 0, 0.1), (0, 0, 0, 0)) if what == "last" else None
    errors = {"error of five": (0.0,) * 5, "endless error": (0.0, 0.0, float("inf"), 0.0, 0.0, 0.0)}
    return MonitorState(references, proposal, cam_T_grip=last, reference_error=errors.get(what))


@pytest.mark.parametrize(
    ("what", "reason"),
    [
        ("nothing", "no reference at all"),
        ("swapped", "revision 1 follows revision 2"),
        ("missing", "revision 3 follows revision 1"),
        ("twice", "two references of one name"),
        ("parent", "but has the parent factory"),
        ("no parent", "but has the parent None"),
        ("restores", "restores never-was, which is not an earlier reference"),
        ("restores itself", "which is not an earlier reference"),
        ("negative", "revision -1"),
        ("short", "a covariance of 35 numbers"),
        ("turned", "no pose"),
        ("far", "no pose"),
        ("proposal", "revision 9 follows revision 3"),
        ("last", "the last transform is not a pose"),
        ("error of five", "the error of the configured reference is not six finite numbers"),
        ("endless error", "the error of the configured reference is not six finite numbers"),
    ],
)
def test_a_state_that_does_not_hold_together_is_told(what: str, reason: str):
    assert reason in state_fault(broken(what))


def test_a_state_that_holds_together_has_no_fault():
    assert state_fault(broken("none")) == ""


def test_what_can_not_be_kept_does_not_get_into_force():
    """Kept first, whoever lets it in; where that fails nothing has changed, and the number names nothing."""
    kept: list[tuple[ReferenceRecord, ...]] = []
    full = False

    def keep(references: tuple[ReferenceRecord, ...]) -> str:
        kept.append(references)
        return "no space left" if full else ""

    book = ReferenceBook(configured(), keep)
    for i, step in enumerate(("a", "a", "p"), start=1):
        take(book, step, i)
    assert kept == [book.history[:2], book.history]
    before = (book.history, book.proposal, book.changes)
    full = True
    ways = (lambda: adopt(book, 7), book.accept, lambda: book.undo(5), lambda: book.reset(5))
    for way in ways:
        with pytest.raises(CommandRefused, match="is not put in force, as a restart would lose it: no space left"):
            way()
        assert kept[-1][-1].revision == 3 and (book.history, book.proposal, book.changes) == before
    full = False
    assert book.undo(5).revision == 3 and kept[-1] == book.history
