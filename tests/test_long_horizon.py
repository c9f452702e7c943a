"""Psi as a linear system, segments and windows: against matrices, fractions and every schedule."""

import contextlib
import copy
import itertools
import pickle
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import landing
import modelselect as ms
from modelselect import ControlTask, SelectionProblem, psi, sensitivity
from modelselect_parts import ahead, label_search, long_horizon, trellis
from modelselect_parts import problem as problem_part
from modelselect_parts import sensitivity as sensitivity_part
from modelselect_parts.regulator import felt_size, observer_of
from modelselect_parts.sensitivity import Sensitivity
from modelselect_parts.triangle import FREE
from perception import textbook_suite

from strategies import tasks

SEEDS = st.integers(0, 2**32 - 1)
SYSTEMS = ("preview", "causal", "measurement", "filter", "reckoning", "a step late")


@pytest.fixture(autouse=True, scope="module")
def rows():
    """Two rows more, with memory and no foresight."""
    reckons = ms.Pattern(lambda look: look.expected, True, False, False, "reckons")
    late = ms.Pattern(lambda look: (look.late + look.expected) / 2, False, False, False, "averages")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ms.PATTERNS, "reckoning", reckons)
        patch.setitem(ms.PATTERNS, "a step late", late)
        yield


def of(task, information):
    """What psi and sensitivity take: a filter has gains, any gains."""
    wants = ms.PATTERNS[information].gains
    shape = (task.horizon, task.n, task.p)
    return task, information, np.random.default_rng(task.n).normal(size=shape) if wants else None


def matrix(*given):
    return psi(*given[:2], gains=given[2])


def system_of(*given):
    return sensitivity(*given[:2], gains=given[2])


@contextlib.contextmanager
def short_parts():
    """Segments of 1 and 2 steps, windows that overlap by 4, and no matrix whatever H is."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem_part, "LONG", 0)
        patch.setattr(ahead, "SEGMENTS", (1, 2))
        patch.setattr(long_horizon, "LAP", 4)
        patch.setattr(ahead, "WIDTHS", (1, 2, 64))
        patch.setattr(ms, "WIDTHS", [1, 2, 2, 64, 4096])
        yield


@contextlib.contextmanager
def handicaps():
    """Segments of 2 and 4 steps, of which every one counts as forgetting what came in."""
    with short_parts(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(ahead, "SEGMENTS", (2, 4))
        patch.setattr(ahead, "LOOK", 2)
        patch.setattr(ahead, "FORGOTTEN", 2.0)
        yield


# ------------------------------------------------------------------------------- the system


@given(tasks(), st.sampled_from(SYSTEMS))
def test_a_system_is_its_matrix(task, information):
    Psi, system = matrix(*of(task, information)), system_of(*of(task, information))
    size = felt_size(task, Psi.diagonal())
    assert (np.abs(np.asarray(system) - Psi) <= 1e-9 * np.outer(size, size)).all()
    np.testing.assert_allclose(
        system.diagonal(), Psi.diagonal(), rtol=1e-9, atol=1e-9 * size.max() ** 2
    )
    np.testing.assert_allclose(np.einsum("tii->ti", system.blocks).ravel(), system.diagonal())
    H, p = task.horizon, task.p
    off = np.abs(Psi.reshape(H, p, H, p)) > 1e-9 * np.outer(size, size).reshape(H, p, H, p)
    off[np.arange(H), :, np.arange(H)] = False
    assert system.coupled or not off.any()
    assert len(system) == p * H


def exactly(system, e):
    """The outputs of a system and its product with e, in fractions of these very floats."""
    number = np.vectorize(Fraction, otypes=[object])
    own, read, carry, push = map(number, (system.own, system.read, system.carry, system.push))
    H, e = len(own), number(e).reshape(len(own), -1)
    eta, v = number(np.zeros(push.shape[1])), [None] * H
    for t in system.order():
        v[t] = read[t] @ eta + own[t] @ e[t]
        eta = carry[t] @ eta + push[t] @ e[t]
    z, found = number(np.zeros(push.shape[1])), [None] * H
    for t in reversed(system.order()):
        found[t] = own[t].T @ v[t] + push[t].T @ z
        z = read[t].T @ v[t] + carry[t].T @ z
    return np.concatenate(found), sum((row @ row for row in v), Fraction(0))


@given(tasks(max_horizon=5), st.sampled_from(SYSTEMS), SEEDS)
def test_products_and_squares_are_off_by_no_more_than_they_say(task, information, seed):
    rng = np.random.default_rng(seed)
    system = system_of(*of(task, information))
    e = rng.normal(size=len(system)) * 10.0 ** rng.integers(-3, 4, len(system))
    product, square = exactly(system, e)
    found, off = sensitivity_part.product(system, e)
    assert all(abs(Fraction(x) - y) <= r for x, y, r in zip(found, product, off, strict=True))
    [found], [off] = sensitivity_part.squares(system, e[None])
    assert abs(Fraction(found) - square) <= off <= 1e-12 * found + 1e-300


def test_digits_count_by_what_is_felt_and_no_less_than_a_billionth_of_the_most():
    one = np.eye(1)
    task = ControlTask(one, one, 2 * one, one, one, 3)  # an error alone costs up to 4
    felt = felt_size(task, np.array([4.0, 1e-6, 0.0]))
    np.testing.assert_allclose(felt, np.sqrt([4, 1e-6, 4e-9]), rtol=1e-12)


def test_what_a_product_may_be_off_by_adds_up_over_steps():
    """Of 25 steps that meet nowhere, each adds a unit of its own output, there and back."""
    one, none = np.ones((25, 1, 1)), np.zeros((25, 1, 1))
    system = Sensitivity(one, one - 1, one, none, False)
    found, off = sensitivity_part.product(system, np.ones(25))
    unit, eps = sensitivity_part._unit(system), sensitivity_part.EPS
    np.testing.assert_array_equal(found, 1)
    np.testing.assert_allclose(off, 2 * unit * (25 + 25) + eps, rtol=1e-9)


def test_states_are_as_long_as_what_they_add_to_later_outputs():
    system = sensitivity(landing.preset("textbook", 40).task, "preview")
    both = np.concatenate([system.read, system.carry], axis=1)
    gram = both.swapaxes(1, 2) @ both
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(gram.shape[1]), gram.shape), atol=1e-13)


@pytest.mark.parametrize("information", ["preview", "filter"])
@pytest.mark.parametrize("part", [slice(0, 4), slice(3, 9), slice(7, 12)])
def test_a_window_is_a_block_of_the_matrix(part, information):
    given = of(replace(landing.preset("textbook", 150).task, horizon=12), information)
    np.testing.assert_allclose(
        sensitivity_part.window(system_of(*given), part), matrix(*given)[part, part], rtol=1e-9
    )


def test_what_is_no_system_is_refused(monkeypatch):
    task = ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3)
    with pytest.raises(ValueError, match=r"^information: 'open_loop' .*use psi"):
        sensitivity(task, "open_loop")
    with pytest.raises(ValueError, match=r"^information: expected one of"):
        sensitivity(task, "oracle")
    with pytest.raises(ValueError, match=r"^gains: required"):
        sensitivity(task, "filter")
    system = sensitivity(task, "preview")
    with pytest.raises(ValueError, match=r"^carry: expected shape"):
        replace(system, carry=system.carry[1:])
    with pytest.raises(ValueError, match=r"^carry: .*orthonormal"):
        replace(system, carry=2 * system.carry)
    with pytest.raises(ValueError, match=r"^errors: expected shape"):
        system @ np.ones(2)
    monkeypatch.setattr(sensitivity_part, "PSI_TOLERANCE", 0.0)
    with pytest.raises(ValueError, match=r"^task: Psi loses its digits"):
        sensitivity(landing.preset("published", 150).task, "preview")


@pytest.mark.parametrize("way", [copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_of_a_system_are_frozen(way):
    system = way(sensitivity(ControlTask([[1]], [[1]], [[1]], [[1]], [[1]], 3), "preview"))
    with pytest.raises(ValueError, match="read-only"):
        system.own[0] = 1
    assert np.asarray(system)[0, 0] == pytest.approx(64 / 65)


def test_an_observer_without_gains_brings_nothing_in():
    task = ControlTask(np.eye(2), [[0], [1]], [[3], [0]], np.eye(2), [[1]], 4)
    blind = observer_of(task, "filter", np.zeros((2, 1)))
    nothing = np.zeros(4)
    np.testing.assert_array_equal(felt_size(task, nothing, blind), felt_size(task, nothing))


# ------------------------------------------------------------------------ problems, and proofs


def a_problem(seed, information=None, H=None):
    """A task of few states, with a suite of mixed signs; as a system, and as a matrix."""
    rng = np.random.default_rng(seed)
    H, W, n = H or int(rng.integers(5, 9)), int(rng.integers(2, 4)), int(rng.integers(1, 3))
    A = rng.normal(size=(n, n)) * rng.choice([0.3, 0.7, 1.0])
    m, p = (int(rng.integers(1, 3)) for _ in range(2))
    C = rng.normal(size=(n, p))
    task = ControlTask(A, rng.normal(size=(n, m)), C, np.eye(n), np.eye(m), H)
    information = information or str(rng.choice(SYSTEMS))
    price = rng.uniform(0, 1, (H, W)) * rng.choice([0, 0.1, 1])
    if rng.random() < 0.3:
        price[rng.integers(H), rng.integers(W)] = np.inf
    given = (rng.normal(size=(H, W, p)), rng.uniform(0, 0.1, (H, W, p)), price)
    pull = rng.normal(size=(H, p)) if rng.random() < 0.3 else None
    weights = {"alpha": float(rng.choice([0.5, 2])), "pull": pull}
    system = SelectionProblem(system_of(*of(task, information)), *given, **weights)
    return system, SelectionProblem(matrix(*of(task, information)), *given, **weights)


@given(SEEDS)
def test_the_long_search_proves_what_every_schedule_costs(seed):
    with short_parts():
        problem, dense = a_problem(seed)
        assert isinstance(problem.psi, Sensitivity)
        H, W, _ = problem.mean.shape
        schedules = np.array(list(itertools.product(range(W), repeat=H)))
        costs = dense.total_cost(schedules)
        np.testing.assert_allclose(problem.total_cost(schedules), costs, rtol=1e-9, atol=1e-9)
        best, slack = costs.min(), 1e-9 * (1 + np.abs(costs[np.isfinite(costs)]).max())
        found = ms.solve(problem)
        assert abs(found.cost - best) <= slack and found.cost - found.lower_bound <= slack
        for found in (ms.dynamic_program(problem, max_labels=2), ms.solve(problem, time_limit=0)):
            assert found.lower_bound <= best + slack and found.cost >= best - slack
            ms.check_certificate(problem, found)


@given(SEEDS, st.integers(9, 11))
def test_budgets_that_forget_lose_no_optimum(seed, H):
    with handicaps():
        problem, dense = a_problem(seed, H=H)
        _, W, _ = problem.mean.shape
        costs = dense.total_cost(np.array(list(itertools.product(range(W), repeat=H))))
        best, slack = costs.min(), 1e-9 * (1 + np.abs(costs[np.isfinite(costs)]).max())
        for found in (ms.solve(problem), ms.dynamic_program(dense)):
            assert abs(found.cost - best) <= slack and found.cost - found.lower_bound <= slack


def test_models_of_no_use_have_no_deviation_in_a_system_either():
    task = ControlTask([[1, 0.1], [0, 1]], [[0], [0.1]], [[0], [0.1]], np.eye(2), [[0.1]], 3)
    mean = np.tile([[0.1], [50.0]], (3, 1, 1))
    with short_parts():
        problem = SelectionProblem(sensitivity(task, "preview"), mean, 0 * mean, [0, np.inf])
        found = trellis.certificate(problem.form, np.zeros(3))
        given_ = found, (np.zeros(3), 0.0), 1.0, 0.0, lambda: False
        parts, _ = long_horizon.prepared(problem.form, *given_)
    np.testing.assert_array_equal(parts.deviation, mean * [[1], [0]])
    np.testing.assert_array_equal(parts.size, 0.1)


def test_no_schedule_of_a_system_is_changed_by_local_search():
    with short_parts():
        problem, _ = a_problem(1)
        found = ms.round_and_swap(problem)
    assert isinstance(problem.psi, Sensitivity) and found.work["swaps"] == 0


@given(SEEDS)
def test_a_matrix_is_searched_by_segments_too(seed):
    with short_parts():
        _, dense = a_problem(seed)
        best = ms.enumerate_schedules(dense).cost
        for most in (1, 2, 2**12):
            found = ms.dynamic_program(dense, max_labels=most)
            slack = 1e-9 * (1 + abs(best))
            assert found.lower_bound <= best + slack and found.cost >= best - slack
        assert found.cost <= best + slack


@pytest.mark.no_cover
@given(SEEDS, st.booleans(), st.sampled_from([(1, 2), (2, 2), (1, 3), None]))
def test_no_bound_of_segments_exceeds_what_a_schedule_adds(seed, as_system, lengths):
    """In exact arithmetic on the rows that the search sums: dolls (None), segments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(problem_part, "LONG", 0)
        if lengths:
            patch.setattr(ahead, "SEGMENTS", lengths)
        problem = a_problem(seed)[0 if as_system else 1]
        form, d = problem.form, ms.relax_interior_point(a_problem(seed)[1]).reference
        found = trellis.certificate(form, d)
        best = ms.enumerate_schedules(a_problem(seed)[1])
        excess = best.cost * np.random.default_rng(seed).choice([1, 1.2, 2]) - found.base
        room = max(excess, 1e-12 * (1 + abs(best.cost)))
        parts, steps = long_horizon.prepared(form, found, (d, 0.0), room, 0.0, lambda: False)
        turn = -1 if as_system and problem.psi.forward else 1
        room = max(room - parts.constant, 1e-12)
        known = best.choices[::turn]
        R = ahead.bounds_ahead(parts, steps, known, room, 0.0, True, lambda: False).least
    assert (R >= 0).all() and (np.diff(R) >= 0).all()
    H, W, _ = problem.mean.shape
    for c in itertools.islice(itertools.product(range(W), repeat=H), 0, None, 7):
        if np.isfinite(parts.moves[np.arange(H), 0, c]).all():
            added = np.cumsum(rows_exactly(parts, steps, c))
            if added[-1] <= room:
                assert all(Fraction(bound) <= x for bound, x in zip(R[1:], added, strict=True))


def least_of_segment(parts, steps, a, b):
    """The least that steps a to b - 1 add, over all choices and offsets: by least squares."""
    W, best = parts.moves.shape[2], np.inf
    for c in itertools.product(range(W), repeat=b - a):
        y, free, rows, effect = 0, np.eye(steps[b - 1].read.shape[1]), [], []
        for t, w in zip(reversed(range(a, b)), reversed(c), strict=True):
            e = parts.deviation[t, w]
            rows.append(steps[t].read @ (0 * free[0] + y) + steps[t].own @ e)
            effect.append(steps[t].read @ free)
            y, free = steps[t].carry @ (0 * free[0] + y) + steps[t].push @ e, steps[t].carry @ free
        rows, G = np.concatenate(rows), np.concatenate(effect)
        left = rows - G @ np.linalg.lstsq(G, rows, rcond=1e-12)[0]
        moves = parts.moves[np.arange(a, b), 0, c].sum()
        best = min(best, moves + left @ left)
    return best


def test_bounds_hold_where_a_step_has_more_rows_than_errors():
    """With rows that no error makes good, what a doll adds does not split as its labels do."""
    for seed in range(15):
        rng = np.random.default_rng(seed)
        H, W, m, n = 6, 3, 2, 1
        both = np.linalg.qr(rng.normal(size=(H, m + n, n)))[0]
        own, push = rng.normal(size=(H, m, 1)), rng.normal(size=(H, n, 1))
        steps = [
            long_horizon.Coordinates(*step)
            for step in zip(own, both[:, :m], both[:, m:], push, np.full(H, 100.0), strict=True)
        ]
        deviation, moves = rng.normal(size=(H, W, 1)), rng.exponential(0.05, (H, 1, W))
        size = np.abs(deviation).max(axis=1).ravel()
        parts = long_horizon.Triangle(0.0, moves, deviation, np.zeros((0, 0)), size, 0.0, 100.0)
        least = [least_of_segment(parts, steps, 0, b) for b in range(1, H)]
        known = moves[:, 0].argmin(axis=1)
        room = float(sum(rows_exactly(parts, steps, known)))
        R = ahead.bounds_ahead(parts, steps, known, room, 1e-12, True, lambda: False).least
        assert (R[1:-1] <= np.array(least) * (1 + 1e-9) + 1e-12).all()


def a_chain(seed):
    """A search of its own: nine steps, two models, and states of which a fifth is handed on."""
    rng = np.random.default_rng(seed)
    H, W, q, n = 9, 2, int(rng.integers(1, 3)), int(rng.integers(1, 3))
    both = rng.normal(size=(H, q + n, n)) * np.append(np.ones(q), np.full(n, 0.2))[:, None]
    both = np.linalg.qr(both)[0]
    own, push = rng.normal(size=(H, q, 1)), rng.normal(size=(H, n, 1))
    deviation, moves = rng.normal(size=(H, W, 1)), rng.exponential(1.0, (H, 1, W))
    size = np.abs(deviation).max(axis=1).ravel()
    steps, reach = [None] * H, 0.0
    for t in reversed(range(H)):
        reach *= np.linalg.norm(both[t, q:], 2)
        reach += np.linalg.norm(push[t]) * size[t]
        steps[t] = long_horizon.Coordinates(own[t], both[t, :q], both[t, q:], push[t], reach)
    return long_horizon.Triangle(0.0, moves, deviation, np.zeros((0, 0)), size, 0.0, 10.0), steps


def test_a_schedule_with_a_model_of_no_use_has_no_handicaps():
    parts, steps = a_chain(20)
    parts.moves[2, 0, 1] = np.inf
    known = np.array([0, 0, 1, 0, 0, 0, 0, 0, 0])
    with handicaps():
        found = ahead.bounds_ahead(parts, steps, known, 9.0, 1e-9, True, lambda: False)
    assert (found.most == np.inf).all() and not found.marks
    assert np.isfinite(found.least).all() and found.least[-1] > 0


def test_a_budget_that_drops_all_labels_proves_no_more_than_itself():
    parts, steps = a_chain(0)
    given_ = label_search.losses(parts, steps, FREE, 1e-3, 1e-6)
    found = label_search.search(parts, steps, FREE, given_, 64, lambda: False)
    assert found.choices is None and found.complete
    assert found.least == given_.budget - given_.total


@pytest.mark.parametrize("seed", range(20, 30))
def test_a_handicap_is_no_less_than_what_another_offset_would_gain(seed):
    """By brute force, over all offsets by least squares; of the best schedule and two others."""
    parts, steps = a_chain(seed)
    schedules = np.array(list(itertools.product(range(2), repeat=9)))
    added = np.array([ahead.follow(parts, steps, c)[0] for c in schedules])
    order, least = np.argsort(added[:, 0]), least_of_segment(parts, steps, 0, 8)
    for known in schedules[order[[0, 20, 60]]]:
        u, offsets = ahead.follow(parts, steps, known)
        limits = float(u[0]), 1e-9
        with handicaps():
            found = ahead.bounds_ahead(parts, steps, known, *limits, True, lambda: False)
            assert (added[order[0]] + found.least <= found.most + 1e-9).all()
            given_ = label_search.losses(parts, steps, FREE, *limits)
            best = label_search.search(parts, steps, FREE, given_, 512, lambda: False, found)
            assert best.complete and best.choices.tolist() == schedules[order[0]].tolist()
            found.least[5:], found.most[5:] = found.least[4], found.most[4]
            given_ = (
                ahead.segment(parts, steps, 4, 8),
                steps,
                4,
                found,
                label_search.Mark(u[8], offsets[8], 0.0, 0.0),
            )
            handicap = ahead._handicap(*given_, *limits, lambda: False)[1]
        halves = itertools.product(range(2), repeat=8)
        assert handicap >= min(from_offset(parts, steps[:8], offsets[8], c) for c in halves) - least
        assert np.isfinite(handicap)


def test_a_handicap_grows_by_what_strays_what_rounds_and_what_is_given_away(monkeypatch):
    """By 2 stray sqrt(B) + stray^2, by 4 eps a step of all that is added, by twice the losses."""
    parts, steps = a_chain(20)
    part, B = ahead.segment(parts, steps, 4, 8), 100.0
    free, _ = ahead.free_start(part, steps, 4, onward=True)
    offset = ahead.follow(parts, steps, np.zeros(9, dtype=int))[1][8]

    def handicap(stray, whole, lost):
        monkeypatch.setattr(ahead, "free_start", lambda *given, **named: (free, stray))
        given_ = label_search.Losses(B, 0.0, 0.0, lost)
        monkeypatch.setattr(ahead, "losses", lambda *given: given_)
        known = label_search.Ahead(np.zeros(10), np.full(10, whole), 2, np.zeros(9))
        mark = label_search.Mark(0.0, offset, 0.0, 0.0)
        return ahead._handicap(part, steps, 4, known, mark, B, 0.0, lambda: False)[1]

    least = handicap(0.0, 1e3, 0.0)
    assert handicap(0.5, 1e3, 0.0) - least == pytest.approx(2 * 0.5 * 10 + 0.25, rel=1e-9)
    assert handicap(0.0, 1e13, 0.0) - least == pytest.approx(4 * 9 * 1e13 / 2**52, rel=1e-6)
    assert handicap(0.0, 1e3, 0.25) - least == pytest.approx(0.5, rel=1e-9)


def test_what_the_best_schedule_known_has_lost_is_never_less_than_it_was():
    """A label that has added 3 less at an offset 1 away, with room 0.5, gains 3 - 2 * 0.5 - 1."""
    nothing, marks = np.zeros(9), {4: label_search.Mark(5.0, np.ones(1), 0.5, 0.0)}
    known = label_search.Ahead(nothing, nothing, 2, nothing, marks=marks)
    labels = label_search.label(np.zeros(1))._replace(extra=np.full(1, 2.0))
    assert known.passed(4, labels).gain == 1.0
    assert known._replace(gain=1.5).passed(4, labels).gain == 1.5
    assert known.passed(3, labels) is known


def from_offset(parts, steps, y, choices):
    """What the steps before b add after an offset y."""
    added = 0.0
    for t, step in reversed(list(enumerate(steps))):
        e = parts.deviation[t, choices[t]]
        felt = step.read @ y + step.own @ e
        added += parts.moves[t, 0, choices[t]] + felt @ felt
        y = step.carry @ y + step.push @ e
    return added


def test_states_are_bounded_where_nothing_is_forgotten():
    """Weights that forget grow beyond all floats there; those that do not bound the sum."""
    H, one = 8000, np.ones((8000, 1, 1))
    system = Sensitivity(one, 0 * one, one, one, False)
    reach = long_horizon._reaches(system, one[..., 0])
    assert np.isfinite(reach).all()
    assert (reach >= np.arange(H, 0, -1) * (1 - 1e-12)).all()


@pytest.mark.parametrize(("q", "n", "p"), [(40, 1, 1), (1, 40, 1), (1, 1, 40), (9, 9, 9)])
def test_the_unit_of_a_system_covers_sums_of_all_its_terms(q, n, p):
    """A row sums n + p products: it is off by n + p units of each (Higham 2002, section 3.1)."""
    parts = np.ones((q, p)), np.zeros((q, n)), np.eye(n), np.ones((n, p))
    system = Sensitivity(*(np.tile(part, (3, 1, 1)) for part in parts), False)
    assert sensitivity_part._unit(system) >= (n + p) * sensitivity_part.WIDE_EPS


def test_squares_err_by_what_they_say_where_large_states_cancel():
    """Step 0 only hands on 1e8; what is felt of it later is all but made good."""
    H, c = 4, (0.6, 0.8)
    own, read, carry, push = (np.full((H, 1, 1), x) for x in (1.0, *c, 1.0))
    own[0] = 0
    e, eta = np.zeros(H), 0.0
    for t in range(H):
        e[t] = 1e8 if t == 0 else 0.3 - c[0] * eta
        eta = c[1] * eta + e[t]
    found, off = sensitivity_part.squares(Sensitivity(own, read, carry, push, True), e[None])
    state, exact = Fraction(0), Fraction(0)
    for t in range(H):
        parts = (Fraction(float(x[t, 0, 0])) for x in (own, read, carry, push))
        own_t, read_t, carry_t, push_t = parts
        exact += (own_t * Fraction(e[t]) + read_t * state) ** 2
        state = carry_t * state + push_t * Fraction(e[t])
    assert off[0] < 1e-6
    assert abs(Fraction(found[0]) - exact) <= Fraction(off[0])


def rows_exactly(parts, steps, c):
    """What each step adds to the excess of a schedule, in fractions of the very floats."""
    number = np.vectorize(Fraction, otypes=[object])
    H = len(steps)
    e, added = number(parts.deviation[np.arange(H), c]), [None] * H
    if len(parts.U):
        rows = number(parts.U) @ e.ravel()
        squares = (rows**2).reshape(H, -1).sum(axis=1)
    else:
        y, squares = number(np.zeros(steps[-1].read.shape[1])), [None] * H
        for t in reversed(range(H)):
            row = number(steps[t].read) @ y + number(steps[t].own) @ e[t]
            squares[t] = row @ row
            y = number(steps[t].carry) @ y + number(steps[t].push) @ e[t]
    for t in range(H):
        added[t] = Fraction(parts.moves[t, 0, c[t]]) + squares[t]
    return added


def test_what_far_steps_feel_is_bounded(monkeypatch):
    monkeypatch.setattr(ahead, "LOOK", 20)
    system = sensitivity(landing.preset("textbook", 150).task, "preview")
    arrays = (system.own, system.read, system.carry, system.push, np.zeros(150))
    steps = [long_horizon.Coordinates(*step) for step in zip(*arrays, strict=True)]
    look, far = ahead.forgetting(steps)
    assert look % 20 == 0 and far[look + 1 :].max() < 1
    for t in range(look + 1, 150):
        on = np.eye(4)
        for k in range(t - 1, t - look - 1, -1):
            on = steps[k].carry @ on
        assert np.linalg.norm(on, 2) ** 2 <= far[t]
    assert (far[: look + 1] == 0).all()


def test_far_steps_feel_what_a_block_of_carries_leaves():
    """Of L = 8 steps that hand on 0.9 each, four are a whole block: 0.9^8 of rho^2, from step 9."""
    one, none = np.ones((1, 1)), np.zeros((1, 1))
    steps = [long_horizon.Coordinates(one, none, 0.9 * one, one, 1.0)] * 30
    far = ahead.forgotten(steps, 8)
    np.testing.assert_allclose(far[9:], 0.9**8, rtol=1e-12)
    assert (far[:9] == 0).all()


def test_offsets_without_coordinates_are_forgotten_at_once():
    none = np.zeros((0, 0))
    steps = [long_horizon.Coordinates(*4 * [none], 0.0)] * 30
    assert (ahead.forgotten(steps, 8) == 0).all()


def test_dolls_bound_what_lies_ahead_in_six_strides():
    parts, steps = a_chain(20)
    parts.moves[:] += 1
    known = np.zeros(9, dtype=int)
    excess = float(ahead.follow(parts, steps, known)[0][0])
    R = ahead.bounds_ahead(parts, steps, known, excess, 1e-9, True, lambda: False).least
    assert (np.diff(R)[[1, 3, 5, 7]] >= 2 - 1e-6).all() and (np.diff(R)[[0, 2, 4, 6, 8]] == 0).all()


def a_long_landing(H, signs, seed=0):
    """The textbook aircraft over and over, in the benchmark's manner."""
    short = landing.preset("textbook", 150).task
    task = replace(short, horizon=H)
    path = np.abs(50 + 50 * np.sin(np.arange(H) * 2 * np.pi / 700))
    suite = textbook_suite(path, np.random.default_rng(seed), signs)
    return task, suite, 50.0


@pytest.mark.parametrize("signs", ["same", "step"])
def test_a_long_landing_is_proved_without_a_matrix_and_costs_what_a_matrix_says(signs):
    task, suite, price = a_long_landing(1001, signs)
    given = (suite.mean, suite.variance, price * suite.cost, 0.8, 0.2)
    problem = SelectionProblem(sensitivity(task, "preview"), *given)
    assert isinstance(problem.psi, Sensitivity)
    found = ms.solve(problem)
    assert found.is_optimal
    ms.check_certificate(problem, found)
    assert "quadratic" not in vars(problem)  # nobody wrote the matrix out
    dense = SelectionProblem(psi(task, "preview"), *given)
    assert dense.total_cost(found.choices) == pytest.approx(found.cost, rel=1e-11)
    assert ms.reference_bound(dense, found.reference)[0] == pytest.approx(
        found.root_bound, rel=1e-9
    )


def test_what_is_forgotten_needs_no_labels(monkeypatch):
    """Budgets that know all that comes would keep half as many again, and more the longer it is."""
    task, suite, price = a_long_landing(2001, "step")
    system = sensitivity(task, "preview")
    problem = SelectionProblem(system, suite.mean, suite.variance, price * suite.cost, 0.8, 0.2)
    found = ms.solve(problem)
    handicap = ahead._handicap
    monkeypatch.setattr(ahead, "_handicap", lambda *given: (handicap(*given)[0], np.inf))
    whole = ms.solve(problem)
    assert found.is_optimal and whole.is_optimal
    assert found.cost == pytest.approx(whole.cost, rel=1e-12)
    assert 1.5 * found.work["labels"].mean() < whole.work["labels"].mean()


def test_a_long_problem_in_three_lines():
    task = ControlTask([[1, 0.1], [0, 1]], [[0], [0.1]], [[0], [0.1]], np.eye(2), [[0.1]], 2000)
    mean = np.tile([[[1.0], [-0.2]], [[-1.0], [0.2]]], (1000, 1, 1))
    problem = SelectionProblem(sensitivity(task, "preview"), mean, 0 * mean, [0, 0.001])
    assert ms.solve(problem).is_optimal


def test_a_system_stays_one_only_where_it_is_long_and_steps_are_free(monkeypatch):
    problem, _ = a_problem(0, "preview", 6)
    assert isinstance(problem.psi, np.ndarray)
    monkeypatch.setattr(problem_part, "LONG", 5)
    problem, dense = a_problem(0, "preview", 6)
    assert isinstance(problem.psi, Sensitivity)
    W = problem.mean.shape[1]
    assert isinstance(replace(problem, budget=100.0).psi, np.ndarray)
    assert isinstance(replace(problem, switch_cost=1 - np.eye(W)).psi, np.ndarray)
    np.testing.assert_allclose(problem.linear, dense.linear)
    c = np.zeros(6, dtype=int)
    assert problem.control_term(c) == pytest.approx(dense.control_term(c), rel=1e-12)
    assert ms.branch_and_bound(problem).cost == pytest.approx(ms.solve(dense).cost)
    np.testing.assert_allclose(problem.quadratic, dense.quadratic, atol=1e-12)
    with pytest.raises(ValueError, match=r"^psi: expected a matrix"):
        ms.plain_dynamic_program(problem)


@pytest.mark.parametrize("information", ["causal", "measurement"])
def test_a_system_without_states_is_solved_step_by_step(information):
    with short_parts():
        problem, dense = a_problem(1, information)
        assert isinstance(problem.psi, Sensitivity)
        found = ms.solve(problem)
        assert found.solver == "solve_separable" and found.is_optimal
        assert found.cost == pytest.approx(ms.solve(dense).cost)
