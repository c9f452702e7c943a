"""Switching costs, a budget, a first model and a pull: against every schedule, and each other."""

import itertools
import warnings
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import modelselect as ms
from modelselect import SelectionProblem
from modelselect_parts import (
    ahead,
    dominance,
    label_search,
    local_search,
    passes,
    relaxations,
    trellis,
)
from modelselect_parts import triangle as triangles

SEEDS = st.integers(0, 2**32 - 1)
EXACT = (ms.enumerate_schedules, ms.plain_dynamic_program, ms.dynamic_program, ms.solve)


def schedules_of(problem):
    H, W, _ = problem.mean.shape
    return np.array(list(itertools.product(range(W), repeat=H)))


def a_problem(seed, *, budget=True):
    """A tiny problem with a mixture of all features; prices may be whole, real or missing."""
    rng = np.random.default_rng(seed)
    H, W, p = (int(rng.integers(1, most)) for most in (5, 4, 4))
    F = rng.normal(size=(p * H, int(rng.integers(1, p * H + 1))))
    if rng.random() < 0.3:
        F = np.round(2 * F)
    mean = rng.normal(size=(H, W, p)) if rng.random() < 0.6 else rng.integers(-2, 3, (H, W, p))
    price = rng.integers(0, 4, (H, W)) * 1.0 if rng.random() < 0.5 else rng.uniform(0, 3, (H, W))
    if rng.random() < 0.3:
        missing = rng.random((H, W)) < 0.3
        missing[np.arange(H), rng.integers(0, W, H)] = False
        price[missing] = np.inf
    switch = rng.integers(0, 3, (W, W)) * 1.0 if rng.random() < 0.5 else rng.uniform(0, 2, (W, W))
    np.fill_diagonal(switch, 0)
    problem = SelectionProblem(
        F @ F.T,
        mean,
        rng.uniform(0, 1, (H, W, p)) * (rng.random() < 0.5),
        price,
        float(rng.choice([0.5, 1, 2])),
        float(rng.choice([0, 0.5, 3])),
        switch_cost=switch if rng.random() < 0.7 else None,
        initial_model=int(rng.integers(W)) if rng.random() < 0.5 else None,
        pull=rng.normal(size=(H, p)) if rng.random() < 0.4 else None,
    )
    if budget and rng.random() < 0.75:
        spent = problem.perception_term(schedules_of(problem))
        spent = np.unique(spent[np.isfinite(spent)])
        problem = replace(problem, budget=float(rng.choice(spent)))  # exactly met by one
    return problem


def plainly(problem, c):
    """Control and perception term of a schedule, as the paper would write the sums."""
    mu = np.concatenate([problem.mean[t, w] for t, w in enumerate(c)])
    control, p = mu @ problem.psi @ mu, problem.mean.shape[2]
    for t, w in enumerate(c):
        block = problem.psi[t * p : (t + 1) * p, t * p : (t + 1) * p]
        control += np.trace(block @ np.diag(problem.variance[t, w]))
        control += 0 if problem.pull is None else problem.pull[t] @ problem.mean[t, w]
    paid = sum(problem.model_cost[t, w] for t, w in enumerate(c))
    before = problem.initial_model
    for w in c if problem.switch_cost is not None else ():
        paid += 0 if before is None else problem.switch_cost[before, w]
        before = w
    return control, paid


@given(SEEDS)
def test_terms_are_the_sums_that_the_definition_writes(seed):
    problem = a_problem(seed, budget=False)
    for c in schedules_of(problem):
        control, paid = plainly(problem, c)
        assert problem.control_term(c) == pytest.approx(control, rel=1e-12, abs=1e-12)
        assert problem.perception_term(c) == pytest.approx(paid, rel=1e-12, abs=1e-12)
        assert problem.is_feasible(c) == np.isfinite(paid)
        if np.isfinite(paid):
            total = problem.alpha * control + problem.beta * paid
            assert problem.total_cost(c) == pytest.approx(total, rel=1e-12, abs=1e-11)
            assert float(problem.exact_cost(c)) == pytest.approx(total, rel=1e-12, abs=1e-11)


@given(SEEDS)
def test_the_certificate_holds_for_every_schedule_point_and_multiplier(seed):
    problem = a_problem(seed)
    rng = np.random.default_rng(seed)
    d, multiplier = rng.normal(size=len(problem.psi)), float(rng.choice([0, 0.5, 10]))
    multiplier *= problem.budget is not None
    bound, reduced = ms.reference_bound(problem, d, multiplier)
    for c in schedules_of(problem):
        if problem.is_feasible(c):
            e = problem.chosen_mean(c) - d
            rest = max(reduced[t, w] for t, w in enumerate(c)) + e @ problem.quadratic @ e
            assert bound + rest <= problem.total_cost(c) + 1e-9
    assert reduced.min() >= 0


@given(SEEDS)
def test_every_solver_finds_and_proves_the_cheapest_feasible_schedule(seed):
    problem = a_problem(seed)
    legal = [c for c in schedules_of(problem) if problem.is_feasible(c)]
    least = min(problem.exact_cost(c) for c in legal)
    rounding = Fraction(problem.rounding) + abs(least) / 10**9
    felt = np.abs(problem.mean).max(axis=1).ravel()  # of an optimum of 0, terms still have a size
    terms = felt @ np.abs(problem.quadratic) @ felt + problem.linear_size.max(axis=1).sum()
    for solver in (*EXACT, ms.branch_and_bound, ms.round_and_swap):
        schedule = solver(problem)
        assert problem.is_feasible(schedule.choices)
        assert Fraction(schedule.lower_bound) <= least + Fraction(problem.rounding)
        if solver is not ms.round_and_swap:
            assert problem.exact_cost(schedule.choices) <= least + rounding, solver.__name__
            undecided = 4 * float(rounding) + 1e-9 * abs(schedule.cost) + 1e-14 * terms
            assert schedule.cost - schedule.lower_bound <= undecided
        ms.check_certificate(problem, schedule)


def test_where_nothing_is_left_of_a_budget_its_price_is_a_small_one():
    """Any price above a few is as good; 148635 cost seven digits of the bound."""
    problem = a_problem(19462)
    cheap, dear = problem.model_cost[0]
    assert problem.budget == dear > cheap == 0  # what is feasible keeps it, one to the last digit
    for solver in EXACT:
        schedule = solver(problem)
        assert schedule.multiplier < 10 and schedule.is_optimal


def a_robots_problem(seed):
    """A task of one or two states, so that offsets have few directions, with all features."""
    rng = np.random.default_rng(seed)
    H, W, n = (int(rng.integers(low, high)) for low, high in ((4, 8), (2, 4), (1, 3)))
    A = rng.normal(size=(n, n)) * rng.choice([0.3, 0.7, 1.0])
    task = ms.ControlTask(A, rng.normal(size=(n, 1)), rng.normal(size=(n, 1)), np.eye(n), [[1]], H)
    switch = rng.uniform(0, 0.5, (W, W)) * (1 - np.eye(W))
    problem = SelectionProblem(
        ms.psi(task, rng.choice(["preview", "open_loop"])),
        rng.normal(size=(H, W, 1)),
        np.zeros((H, W, 1)),
        rng.uniform(0, 1, (H, W)) * rng.choice([0, 0.1, 1]),
        switch_cost=switch if rng.random() < 0.5 else None,
    )
    if rng.random() < 0.5:
        spent = problem.perception_term(schedules_of(problem))
        problem = replace(problem, budget=float(rng.choice(spent)))
    return problem


@given(SEEDS)
def test_passes_that_drop_labels_still_prove_nothing_false(seed):
    # Widths so narrow that tiny problems come to disturbed schedules and to prefix bounds.
    problem = a_robots_problem(seed) if seed % 2 else a_problem(seed)
    schedules = schedules_of(problem)
    costs = problem.total_cost(schedules)[problem.is_feasible(schedules)]
    best = costs.min()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ms, "WIDTHS", [1, 1, 1, 2, 3])
        patch.setattr(ms, "PERTURBATIONS", 2)
        for most in (1, 3, 2**18):
            found = ms.dynamic_program(problem, max_labels=most)
            slack = 1e-9 * max(abs(best), 1e-9)
            assert found.lower_bound <= best + slack and found.cost >= best - slack
            assert problem.is_feasible(found.choices)
        # Of an optimum of 0, a Psi that is indefinite by a rounding leaves as much undecided.
        undecided = found.cost - found.lower_bound
        assert found.gap < 1e-6 or undecided < 1e-12 * np.abs(costs).max()


@given(SEEDS, st.integers(0, 3), st.integers(1, 60), st.booleans(), st.sampled_from([0, 60]))
def test_only_labels_that_spent_no_less_are_dominated(seed, dimensions, labels, whole, few):
    rng = np.random.default_rng(seed)
    draw = (lambda size: rng.integers(0, 4, size) / 4) if whole else rng.random
    extra, y = np.sort(draw(labels)), draw((labels, dimensions)) / 4
    spent, state = draw(labels), rng.integers(0, 2, labels)
    room = np.sqrt(1 - extra)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dominance, "FEW", few)
        kept = dominance.undominated(extra, y.T, room, 0.0, lambda: False, state, None, spent, 0.5)
    paid = extra - 0.5 * spent
    assert kept.any()
    for j in np.flatnonzero(~kept):
        rho = np.linalg.norm(y - y[j], axis=1)
        claim = paid + 2 * rho * np.sqrt(1 - extra[j]) + rho**2 <= paid[j] + 1e-12
        claim &= (state == state[j]) & (spent <= spent[j])
        claim[j] = False
        assert claim.any(), "no label of its state that spent no more dominates it"


@given(SEEDS, st.integers(1, 60), st.sampled_from([0, 10**9]), st.sampled_from([0, 60]))
def test_a_label_of_another_model_costs_no_more_whatever_comes_before(seed, labels, many, few):
    rng = np.random.default_rng(seed)
    moves = rng.random((2, 3, 3)) / 4
    moves[0, :, 2] = np.where(rng.random() < 0.5, np.inf, moves[0, :, 2])  # of no use
    before_all, detour, *_ = dominance.detours(moves)
    assert dominance.detours(moves[:, :1]) is None and not before_all.any()
    extra, state = np.sort(rng.random(labels)), rng.integers(0, 3, labels)
    y = rng.normal(size=(labels, 3)) * [0.1, 0.01, 1e-9]
    room = np.sqrt(1 - extra)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dominance, "MANY", many)
        patch.setattr(dominance, "FEW", few)
        kept = dominance.undominated(extra, y.T, room, 0.0, lambda: False, state, detour)
    v = rng.normal(size=(40, 3)) / 4
    whole = extra[:, None] + ((v + y[:, None]) ** 2).sum(axis=-1)
    whole = whole[:, None] + moves[0, state][:, :, None]  # [label, model before, v]
    within = whole <= 1
    best = np.where(kept[:, None, None], whole, np.inf).min(axis=0)
    assert kept.any() and (best <= whole + 1e-12)[within].all()


@pytest.mark.parametrize(
    ("toll", "limited", "counts"),
    [(0.1, False, [1, 1, 1]), (0.3, False, [1, 2, 2]), (0.1, True, [2, 2, 2])],
)
def test_a_dearer_label_goes_if_a_move_to_its_model_costs_no_more(toll, limited, counts):
    """At the last step model 1 costs 0.2 more; before, only moves cost, the same everywhere."""
    moves = np.array([*[[[0, toll], [toll, 0]]] * 2, [[0, 0.2]] * 2])
    nothing = np.zeros((3, 2, 1))
    triangle = triangles.Triangle(0.0, moves, nothing, np.zeros((3, 3)), np.zeros(3), 0.0, 0.0)
    r0 = (np.zeros((1, 1)), np.zeros((1, 0)), np.zeros((0, 0)), np.zeros((0, 1)))
    purse = triangles.Purse(0.0, 0 * moves, np.zeros((3, 2)), 1.0, 1.0, 0.0)
    given_ = label_search.Losses(1.0, 1e-12, 0.0, 0.0)
    steps, purse = [triangles.Coordinates(*r0, 0.0)] * 3, purse if limited else triangles.FREE
    found = label_search.search(triangle, steps, purse, given_, 99, lambda: False)
    assert found.labels.tolist() == counts
    assert found.choices.tolist() == [0, 0, 0] and found.least == 0


@pytest.mark.parametrize("toll", [0.0, 0.5])
def test_a_purse_knows_what_moves_spend_and_the_least_that_was_spent_before(toll):
    price, mean = np.array([[1.0, 2], [0, -1], [5, 3], [9, np.inf]]), np.zeros((4, 2, 1))
    switch = toll * (1 - np.eye(2)) if toll else None
    problem = SelectionProblem(np.eye(4), mean, mean, price, switch_cost=switch, budget=20.0)
    purse = triangles.purse(problem.form, 3.0)
    assert (purse.multiplier, purse.limit) == (3.0, problem._limit)
    assert purse.size == pytest.approx(problem._limit + 2)  # a refund of 1 is of size 2
    assert purse.grain == pytest.approx(4 * np.finfo(float).eps * purse.size)
    for t, w in np.ndindex(4, 2):
        if np.isfinite(price[t, w]):
            ways = [(*way, w) for way in itertools.product((0, 1), repeat=t)]
            spent = [
                sum(price[k, c] for k, c in enumerate(way[:-1]))
                + toll * sum(a != b for a, b in itertools.pairwise(way))
                for way in ways
            ]
            assert purse.ahead[t, w] == pytest.approx(min(spent), abs=1e-12)
        for v in range(2) if toll else ():  # the state: the model of the step after
            assert purse.spend[t, v, w] == price[t, w] + toll * (v != w and t < 3)


@pytest.mark.parametrize("states", [1, 2])
def test_the_budget_of_a_pass_solves_the_equation_of_what_it_gives_away(states):
    """Three steps drop 0.2 each: x = 0.6.  Where moves cost something, all grids come twice."""
    none = np.zeros((0, 0))
    moves, nothing = np.zeros((3, states, 2)), np.zeros((3, 2, 1))
    triangle = triangles.Triangle(0.0, moves, nothing, none, np.zeros(3), 0.3, 0.0)
    steps = [triangles.Coordinates(none, none, none, none, reach=0.0, lost=0.2)] * 3
    purse = triangles.Purse(2.0, moves, np.zeros((3, 2)), 1.0, 1.0, grain=0.01)
    found = label_search.losses(triangle, steps, purse, excess=5.0, slack=0.8)
    tests = states * len(dominance.GRIDS)
    rest = 0.8 / 4 + 0.3 + 2.0 * found.grains
    assert found.grains == pytest.approx(3 * (tests + 1) * 0.01)
    assert found.budget == pytest.approx(5 + rest + 2 * 0.6 * found.budget**0.5 + 0.36, rel=1e-12)
    assert found.total == pytest.approx(found.budget - 5)
    assert 3 * tests * found.merge == pytest.approx(0.8 / 4)


def test_directions_of_the_strength_that_is_negligible_give_away_three_quarters_of_the_slack():
    """Losses' x is at most H strength sqrt(pH), and takes 2 x sqrt(excess + slack)."""
    nothing, none = np.zeros((5, 2, 3)), np.zeros((0, 0))
    triangle = triangles.Triangle(0.0, nothing[:, None], nothing, none, np.zeros(15), 0.0, 0.0)
    strength = label_search.negligible_strength(triangle, excess=7.0, slack=2.0)
    assert 2 * (5 * strength * 15**0.5) * 3 == pytest.approx(0.75 * 2)
    assert label_search.negligible_strength(triangle, 0.0, 0.0) == 0


def test_pairs_that_a_quick_look_lets_through_are_looked_at_whole():
    """The coordinates left out are wide here, and decide for some of the pairs."""
    rng = np.random.default_rng(0)
    y, paid, room = rng.normal(size=(4, 60)), rng.exponential(1, 60), rng.exponential(0.2, 60)
    far = ((y[2:].max(axis=1) - y[2:].min(axis=1)) ** 2).sum()
    pairs = dominance.Pairs(paid, room, y, y[:2], far)
    i, j = np.indices((60, 60)).reshape(2, -1)
    due = paid[j] + rng.exponential(3, 3600)
    whole, near = pairs.never_worse(i, j, due), pairs._replace(y=y[:2]).never_worse(i, j, due)
    np.testing.assert_array_equal(pairs.screened(i, j, due), whole)
    assert 100 < whole.sum() < near.sum() - 100


@pytest.mark.parametrize("few", [0, 96])
@pytest.mark.parametrize(("detour", "kept"), [(0.0, [0]), (0.1, [0]), (0.3, [0, 1])])
def test_among_many_labels_too_the_cheapest_stands_for_those_of_the_other_model(
    few, detour, kept, monkeypatch
):
    monkeypatch.setattr(dominance, "FEW", few)
    n = dominance.MANY + 88
    extra, state = np.append(0, np.linspace(0.2, 0.9, n - 1)), np.arange(n) % 2
    across = detour * (1 - np.eye(2))
    given_ = extra, np.zeros((1, n)), np.sqrt(1 - extra), 0.0, lambda: False, state
    assert np.flatnonzero(dominance.undominated(*given_, across)).tolist() == kept
    assert np.flatnonzero(dominance.undominated(*given_)).tolist() == [0, 1]


@given(SEEDS)
def test_the_search_is_left_with_the_models_through_which_a_path_stays_within_the_excess(seed):
    problem, rng = a_problem(seed, budget=False), np.random.default_rng(seed)
    d = rng.normal(size=len(problem.psi))
    found = trellis.certificate(problem.form, d)
    through = found.reduced + (found.bound - found.base)
    paths = schedules_of(problem)
    costs = problem.total_cost(paths)
    for value in np.unique(through[np.isfinite(through)]):
        excess = max(0.0, value) * (1 + 1e-9)
        left = np.isfinite(triangles.factor(problem.form, found, d, 0.0, excess).moves).any(axis=1)
        assert not left[through > excess].any()
        better = paths[costs < found.base + excess]
        assert left[np.arange(len(left)), better].all()  # none of these has lost a model


@given(SEEDS, st.integers(1, 6), st.integers(1, 30))
def test_coordinates_that_tell_labels_apart_are_those_that_spread(seed, dimensions, labels):
    rng = np.random.default_rng(seed)
    y = rng.normal(size=(dimensions, labels)) * 10.0 ** rng.integers(-9, 1, (dimensions, 1)) + 1
    near, spread, far = dominance._telling(y, 1e-4)
    widths = np.sort(np.ptp(y, axis=1))[::-1]
    np.testing.assert_array_equal(spread, widths[widths > 1e-4])
    np.testing.assert_array_equal(np.ptp(near, axis=1), spread)
    assert far == pytest.approx((widths[widths <= 1e-4] ** 2).sum())


@given(SEEDS)
def test_no_price_of_a_budget_beats_the_best_one_by_much(seed):
    problem = a_problem(seed)
    schedules = schedules_of(problem)
    cost, spent = problem.total_cost(schedules), problem.perception_term(schedules)
    cost, spent = cost[np.isfinite(cost)], spent[np.isfinite(cost)]
    limit = float(np.quantile(spent, 0.3))
    legal = np.flatnonzero(spent <= limit)
    k = legal[cost[legal].argmin()]
    tried = []

    def cut_at(lam):
        tried.append(lam)
        c = (cost + lam * (spent - limit)).argmin()
        return passes.Cut(float(cost[c]), float(spent[c]))

    known = passes.Cut(float(cost[k]), float(spent[k]))
    first = float(np.random.default_rng(seed).random())
    lam = passes.best_price(cut_at, limit, known, first, lambda: False)
    asked = len(tried)
    assert passes.best_price(cut_at, limit, known, first, lambda: True) == first
    assert len(tried) == asked + 1  # out of time
    del tried[asked:]
    tiny = 1e-12 * np.abs(cost).max()
    assert lam in tried and lam >= 0 and len(tried) <= passes.CUTS
    bound = float((cost + lam * (spent - limit)).min())
    # The best price lies where two schedules cost the same, or at 0.
    rise, run = cost[:, None] - cost, spent - spent[:, None]
    prices = (rise[run > 0] / run[run > 0]).clip(0)
    L = [(cost + price * (spent - limit)).min() for price in (0.0, *prices)]
    assert bound <= max(L) + tiny <= cost[k] + 2 * tiny
    assert len(tried) == passes.CUTS or max(L) - bound <= 0.1 * (cost[k] - bound) + tiny


def test_one_iteration_bounds_every_schedule():
    problem = a_problem(0)
    point = ms.relax_by_columns(problem, max_iterations=1)
    assert point.iterations == 1 and point.bound <= ms.enumerate_schedules(problem).cost


@pytest.mark.parametrize("solver", [*EXACT, ms.branch_and_bound, ms.round_and_swap])
@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("moves", [False, True])
def test_nothing_depends_on_units(moves, limited, solver):
    """Powers of two change no digit: the work, too, is the same to the last label."""
    rng, H, W = np.random.default_rng(3), 4, 3
    F, price = rng.normal(size=(H, H)), 4 * np.sort(rng.random(W))
    cost, error = 2.0**-200, 2.0**9
    terms = {  # in one unit, and how many times as large they are in the other
        "psi": (F @ F.T, cost / error**2),
        "mean": (rng.normal(size=(H, W, 1)), error),
        "variance": (rng.random((H, W, 1)), error**2),
        "model_cost": (price, cost),
        "pull": (rng.normal(size=(H, 1)), cost / error),
    }
    if moves:
        terms["switch_cost"] = (rng.random((W, W)) * (1 - np.eye(W)), cost)
    if limited:
        terms["budget"] = (H * (3 * price[0] + price[1]) / 4, cost)
    one = solver(SelectionProblem(**{name: value for name, (value, _) in terms.items()}))
    other = solver(SelectionProblem(**{name: value * k for name, (value, k) in terms.items()}))
    assert (other.choices == one.choices).all()
    for name, k in (("cost", cost), ("lower_bound", cost), ("reference", error)):
        np.testing.assert_allclose(getattr(other, name), k * getattr(one, name), 1e-13)
    for count in {"labels", "passes", "complete", "nodes", "swaps"} & set(one.work):
        assert np.array_equal(other.work[count], one.work[count])


@given(SEEDS, st.sampled_from([1.0, 1e6, 1e12]))
def test_the_certificate_takes_no_more_off_than_it_says(seed, size):
    """In fractions, of errors that cancel: a margin may rest on it from both sides."""
    rng = np.random.default_rng(seed)
    H, W = 4, 3
    g = rng.integers(-9, 10, (H, 2)).astype(float)
    mean = np.round(size * rng.normal(size=(H, W, 1)))
    limits = {"switch_cost": rng.random((W, W)) * (1 - np.eye(W)), "budget": 99.0}
    problem = SelectionProblem(g @ g.T, mean, 0 * mean, rng.random((H, W)), **limits)
    d, lam = size * rng.normal(size=H), float(rng.random())
    found, form = trellis.certificate(problem.form, d, lam), problem.form
    K, A = Fraction(form.limit), form.priced(lam)
    for c in schedules_of(problem)[::7]:
        moves = list(itertools.pairwise(c.tolist()))
        spent = sum(Fraction(form.price[t, w]) for t, w in enumerate(c))
        spent += sum(Fraction(form.toll[v, w]) for v, w in moves)
        e = [Fraction(x) - Fraction(y) for x, y in zip(mean[range(H), c, 0], d, strict=True)]
        quadratic = sum(Fraction(form.M[i, j]) * e[i] * e[j] for i in range(H) for j in range(H))
        total = problem.exact_cost(c) + Fraction(lam) * (spent - K)
        path = sum(Fraction(found.node[t, w]) for t, w in enumerate(c))
        path += sum(Fraction(A[v, w]) for v, w in moves)
        assert 0 <= total - Fraction(found.base) - path - quadratic <= Fraction(found.taken)


@pytest.mark.parametrize("multiplier", [1e3, 1e9])
def test_a_certificate_may_state_what_is_exact_where_the_price_of_the_budget_cancels(multiplier):
    """lam (spent - K) is next to 0: what its two parts lose is forgiven, and no more."""
    price, lam = [[0.1, 0.5], [0.2, 0.3], [0.7, 0.9]], Fraction(multiplier)
    zero = np.zeros((3, 2, 1))
    problem = SelectionProblem(np.eye(3), zero, zero, price, budget=1.0)
    bound = sum((1 + lam) * Fraction(row[0]) for row in price) - lam * Fraction(problem._limit)
    cost, d = float(problem.total_cost([0, 0, 0])), np.zeros(3)
    given_ = cost, float(bound), float(bound), d, "by hand", {}, multiplier
    honest = ms.Schedule(np.zeros(3, int), *given_)
    assert ms.check_certificate(problem, honest) <= bound
    for off in (-1e-9, 1e-9):
        with pytest.raises(ValueError, match=r"^schedule\.root_bound: "):
            wrong = honest.root_bound + off * multiplier
            ms.check_certificate(problem, replace(honest, root_bound=wrong))


@pytest.mark.parametrize("seed", range(6))
def test_a_segment_adds_the_least_over_what_comes_after_it(seed):
    """Dense least squares over the offsets of later errors, and the cheapest move to go on with."""
    problem = replace(a_robots_problem(seed), budget=None)
    (H, W, p), d = problem.mean.shape, np.zeros(len(problem.psi))
    switch = np.random.default_rng(seed).uniform(0, 1, (W, W)) * (1 - np.eye(W))
    form = replace(problem, switch_cost=switch).form
    whole = triangles.factor(form, trellis.certificate(form, d), d, 0.0, 1e3)
    steps = triangles.compress(whole, 1e-9, lambda: False)
    for a, b in itertools.combinations(range(0, H, 2), 2):
        part = ahead.segment(whole, steps, a, b)
        assert len(part.moves) == len(part.deviation) == b - a
        free, _ = ahead.free_start(part, steps, a, onward=False)
        G, t = whole.U[a * p : b * p, b * p :], np.arange(a, b)
        for c in itertools.islice(itertools.product(range(W), repeat=b - a), 0, None, 3):
            rows = whole.U[a * p : b * p, a * p : b * p] @ whole.deviation[t, c].ravel()
            left = rows - G @ np.linalg.lstsq(G, rows, rcond=1e-9)[0]
            on = [whole.moves[a + k, w, v] for k, (v, w) in enumerate(itertools.pairwise(c))]
            least = sum(on) + whole.moves[b - 1, :, c[-1]].min() + left @ left
            assert ahead.follow(part, free, np.array(c))[0][0] == pytest.approx(least, abs=1e-6)


@pytest.mark.parametrize(("labels", "gone", "rests"), [(4, 1, 2), (3, 1, 0), (3, 2, 0), (2, 0, 2)])
def test_a_test_that_drops_less_than_a_third_rests_for_two_steps(labels, gone, rests):
    y = np.maximum(np.arange(labels) - gone, 0.0)[None]  # so many are like the first
    nothing, states = np.zeros(labels), np.zeros(labels, dtype=int)
    partial = label_search.Labels(nothing, nothing, y, states)
    purse = triangles.Purse(0.0, np.zeros((1, 1, 2)), None, 1.0, 1.0, 0.0)
    given_ = label_search.Losses(1.0, 0.0, 0.0, 0.0)
    told = purse, given_, np.inf, None, 0, lambda: False
    kept, found = label_search._survivors(partial, nothing, *told)
    assert (len(kept), found) == (labels - gone, rests)


@given(SEEDS, st.integers(0, 2), st.integers(1, 60), st.sampled_from([0, 60]))
def test_labels_that_a_margin_drops_lead_to_no_schedule_within_the_budget(seed, r, labels, few):
    # With completions |v + y|^2 + c, each label's least excess is known; none is below the floor.
    rng = np.random.default_rng(seed)
    y, state = rng.normal(size=(labels, r)) / 2, rng.integers(0, 2, labels)
    extra, spent = np.sort(rng.random(labels)), rng.random(labels)
    v = rng.normal(size=(9, r))
    whole = extra[:, None] + ((v + y[:, None]) ** 2).sum(axis=-1)  # of every completion
    floor, budget = float(whole.min()), float(np.quantile(whole, 0.3))
    given_ = label_search.Losses(budget, 0.0, 0.0, 0.0)
    room = np.sqrt(np.maximum(budget - extra, 0))
    purse = triangles.Purse(0.5, np.zeros((1, 2, 2)), None, 1.0, 1.0, 0.0)
    partial = label_search.Labels(extra, spent, y.T, state)
    expired = lambda: False  # noqa: E731
    margins, detour = (np.inf, budget - floor), np.zeros((2, 2))
    told = purse, given_
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dominance, "FEW", few)
        without, kept = (
            label_search._survivors(partial, room, *told, margin, detour, 0, expired)[0]
            for margin in margins
        )
    gone = np.setdiff1d(np.arange(labels), kept)
    assert set(kept) <= set(range(labels)) and len(kept) <= len(without)
    for j in gone:
        near = (state == state[j]) & (spent <= spent[j]) & (np.arange(labels) != j)
        paid, rho = extra - 0.5 * spent, np.linalg.norm(y - y[j], axis=1)
        dominated = near & (paid + 2 * rho * room[j] + rho**2 <= paid[j] + 1e-12)
        assert dominated.any() or (whole[j] >= budget - 1e-12).all()


@pytest.mark.parametrize("seed", range(12))
def test_the_plain_programme_pays_for_moves_from_where_it_is(seed):
    rng = np.random.default_rng(seed)
    g, switch = rng.normal(size=(5, 2)), rng.random((3, 3)) * (1 - np.eye(3))
    mean, price = rng.normal(size=(5, 3, 1)), rng.random(3)
    problem = SelectionProblem(g @ g.T, mean, 0 * mean, price, switch_cost=switch)
    plain, least = ms.plain_dynamic_program(problem), ms.enumerate_schedules(problem).cost
    assert plain.is_optimal and plain.cost == pytest.approx(least, rel=1e-12)
    assert plain.lower_bound <= least * (1 + 1e-12)


def test_where_a_budget_makes_nodes_slow_passes_have_all_of_a_limit(
    monkeypatch, ten_seconds_a_pass
):
    rng = np.random.default_rng(5)
    g, mean = rng.normal(size=(30, 2)), rng.normal(size=(30, 4, 1))
    problem = SelectionProblem(g @ g.T, mean, 0 * mean, rng.random((30, 4)), budget=9.0)
    monkeypatch.setattr(ms, "WIDTHS", [2 * 8**k for k in range(8)])
    monkeypatch.setattr(ms, "branch_and_bound", None)
    assert ms.solve(problem, time_limit=100).is_optimal and ten_seconds_a_pass[0] > 10


def test_a_price_of_the_budget_proves_what_the_relaxation_leaves_open():
    # Mixtures of biases of opposite sign promise much; switches between them spend the budget.
    H, one = 30, np.eye(1)
    mean = np.tile([[1.0], [-1.2], [0.1]], (H, 1, 1))
    limits = {"switch_cost": 2.0 * (1 - np.eye(3)), "budget": 22}
    Psi = ms.psi(ms.ControlTask(one, one, one, one, one, H))
    problem = SelectionProblem(Psi, mean, 0 * mean, [0, 0, 1.5], beta=0.01, **limits)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ms, "WIDTHS", [8, 8, 64, 512, 8192])
        found = ms.dynamic_program(problem, max_labels=8192)
        patch.setattr(passes.Search, "may_price", lambda search: False)
        without = ms.dynamic_program(problem, max_labels=8192)
    assert found.is_optimal and not without.is_optimal
    assert without.lower_bound <= found.cost <= without.cost


@given(SEEDS)
def test_the_best_interval_of_steps_goes_to_one_model_until_none_helps(seed):
    problem = a_problem(seed)
    H, W, _ = problem.mean.shape
    intervals = [slice(a, b + 1) for b in range(H) for a in range(b + 1)]

    def best_change(c):
        near = np.array([c] + [c] * len(intervals) * W)
        for k, (part, w) in enumerate(itertools.product(intervals, range(W))):
            near[k + 1, part] = w
        return problem.total_cost(near[problem.is_feasible(near)]).min()

    form, start = problem.form, trellis.cheapest_path(problem._price, problem.switch_cost)
    clock = iter([1.0, 0.0])
    once, _ = local_search.swap_blocks(form, start, 1e-9, lambda: next(clock))
    end, _ = local_search.swap_blocks(form, start, 1e-9, lambda: 1.0)
    assert problem.is_feasible(np.array([once, end])).all()
    assert problem.total_cost(once) == pytest.approx(best_change(start), abs=2e-9)
    assert problem.total_cost(end) == pytest.approx(best_change(end), abs=2e-9)


def test_intervals_end_where_their_model_is_missing():
    price = np.zeros((5, 2))
    price[2, 1] = np.inf
    mean, switch = np.tile([[1.0], [0.0]], (5, 1, 1)), 0.1 * (1 - np.eye(2))
    problem = SelectionProblem(np.eye(5), mean, 0 * mean, price, switch_cost=switch)
    start = np.zeros(5, dtype=int)
    found, count = local_search.swap_blocks(problem.form, start, 1e-9, lambda: 1.0)
    assert found.tolist() == [1, 1, 0, 1, 1] and count == 2


def test_schedules_are_disturbed_where_no_single_change_helps():
    switch = np.array([[0, 1.0], [1, 0]])
    problem = SelectionProblem(
        np.ones((6, 6)),
        np.tile([[1.0], [-1.0]], (6, 1, 1)),
        np.zeros((6, 2, 1)),
        [0, 1.0],
        switch_cost=switch,
        budget=4,
    )
    start = np.zeros(6, dtype=int)
    better = local_search.perturbed(problem.form, start, 50, 1e-12, lambda: 1.0)
    assert problem.total_cost(better) == ms.enumerate_schedules(problem).cost == 4
    assert local_search.perturbed(problem.form, start, 0, 1e-12, lambda: 1.0).tolist() == [0] * 6


@given(SEEDS)
def test_the_front_is_that_of_all_schedules(seed):
    problem = a_problem(seed, budget=False)
    everything = schedules_of(problem)
    everything = everything[problem.is_feasible(everything)]
    control, spent = problem.control_term(everything), problem.perception_term(everything)
    tiny = 1e-8 * (1 + np.abs(control).max())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        front = ms.pareto_front(problem)
    found = [(problem.control_term(s.choices), problem.perception_term(s.choices)) for s in front]
    assert all(a[0] < b[0] and a[1] > b[1] for a, b in itertools.pairwise(found))
    for j, k in found:
        assert not ((control < j - tiny) & (spent <= k + 1e-9)).any()
    for j, k in zip(control, spent, strict=True):
        assert any(a <= j + tiny and b <= k + 1e-9 for a, b in found)


def test_a_coarser_front_keeps_its_distance():
    rng, H = np.random.default_rng(0), 6
    mean, Psi = np.array([2.0, 1, 0])[:, None] + rng.random((H, 3, 1)), np.ones((H, H)) + np.eye(H)
    problem = SelectionProblem(Psi, mean, 0 * mean, [0.1, 0.25, 0.7])
    spent = [problem.perception_term(s.choices) for s in ms.pareto_front(problem, resolution=1.0)]
    assert 2 < len(spent) < len(ms.pareto_front(problem))
    assert (-np.diff(spent) >= 1 - 1e-9).all()


def test_a_front_without_time_says_where_it_ends():
    problem = SelectionProblem(
        np.ones((30, 30)) + np.eye(30),
        np.random.default_rng(0).normal(size=(30, 3, 1)),
        np.zeros((30, 3, 1)),
        [0.1, 0.21, 0.37],
    )
    with pytest.warns(UserWarning, match="not proved from perception inf down to 3"):
        assert ms.pareto_front(problem, time_limit=0) == []


@pytest.mark.parametrize("unit", [1.0, 3.0, 1e14])
def test_a_front_is_the_same_in_any_unit_of_the_prices(unit):
    rng, H = np.random.default_rng(0), 5
    mean, Psi = np.array([2.0, 1, 0])[:, None] + rng.random((H, 3, 1)), np.ones((H, H)) + np.eye(H)
    problem = SelectionProblem(Psi, mean, 0 * mean, np.array([0, 1, 3]) * unit)
    front = ms.pareto_front(problem, time_limit=60)
    spent = [problem.perception_term(point.choices) / unit for point in front]
    assert spent == [15.0, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0]


@pytest.mark.parametrize("budget", [None, 4.0, 3.0])
def test_a_front_tells_how_far_it_is(budget):
    mean, told = np.array([2.0, 1, 0])[:, None] + np.zeros((6, 3, 1)), []
    Psi = np.ones((6, 6)) + np.eye(6)
    problem = SelectionProblem(Psi, mean, 0 * mean, [0.5, 1, 2], budget=budget)
    front = ms.pareto_front(problem, progress=told.append)
    spent = np.array([problem.perception_term(point.choices) for point in front])
    assert told[-1] == 1 and told == sorted(told) and len(told) >= len(front)
    assert spent[-1] == 3  # six times 0.5
    shares = (spent[0] - spent) / max(spent[0] - 3, 1)
    assert budget == 3 or all(min(abs(share - np.array(told))) < 1e-9 for share in shares)


@given(SEEDS)
def test_a_switching_cost_of_zero_is_none(seed):
    problem = replace(a_problem(seed), switch_cost=None, budget=None, initial_model=None)
    W = problem.mean.shape[1]
    free = ms.solve(replace(problem, switch_cost=np.zeros((W, W)), initial_model=0))
    plain = ms.solve(problem)
    assert (free.choices == plain.choices).all()
    assert (free.cost, free.lower_bound) == (plain.cost, plain.lower_bound)


@given(SEEDS)
def test_prohibitive_switching_leaves_the_best_constant(seed):
    problem = replace(a_problem(seed), budget=None, initial_model=None, beta=1.0)
    H, W, _ = problem.mean.shape
    problem = replace(problem, switch_cost=1e6 * (1 - np.eye(W)))
    constant = np.repeat(np.arange(W)[:, None], H, axis=1)
    costs = problem.total_cost(constant)
    if np.isfinite(costs).any():
        found = ms.solve(problem)
        assert found.cost == pytest.approx(np.min(costs), rel=1e-9, abs=1e-9)


@given(SEEDS)
def test_more_budget_never_costs_more_and_the_multiplier_brackets_what_it_is_worth(seed):
    problem = a_problem(seed)
    if problem.budget is None:
        return
    more = replace(problem, budget=problem.budget + 0.5)
    tight, loose = ms.solve(problem), ms.solve(more)
    assert loose.cost <= tight.cost + 1e-9 * (1 + abs(tight.cost))
    # LB(d, lam) falls by lam per unit, so the bound at one budget bounds the other's relaxation.
    a, b = ms.relax_by_columns(problem), ms.relax_by_columns(more)
    saved, tiny = a.value - b.value, 1e-6 * (1 + abs(a.value))
    assert 0.5 * b.multiplier - tiny <= saved <= 0.5 * a.multiplier + tiny


@given(SEEDS)
def test_models_may_be_permuted_split_and_priced_alike(seed):
    problem = a_problem(seed)
    H, W, _ = problem.mean.shape
    cost, tiny = ms.solve(problem).cost, 1e-8
    order = np.random.default_rng(seed).permutation(W)

    def picked(order):
        switch, first = problem.switch_cost, problem.initial_model
        return replace(
            problem,
            mean=problem.mean[:, order],
            variance=problem.variance[:, order],
            model_cost=problem.model_cost[:, order],
            switch_cost=None if switch is None else switch[np.ix_(order, order)],
            initial_model=None if first is None else int(np.flatnonzero(order == first)[0]),
        )

    for other in (picked(order), picked(np.append(np.arange(W), W - 1))):
        assert ms.solve(other).cost == pytest.approx(cost, rel=1e-9, abs=tiny)
    dearer = replace(problem, model_cost=problem.model_cost + 1, budget=None)
    if problem.budget is not None:
        dearer = replace(dearer, budget=problem.budget + H)
    expected = cost + problem.beta * H
    assert ms.solve(dearer).cost == pytest.approx(expected, rel=1e-9, abs=tiny)


def test_what_switching_and_a_budget_change_in_three_lines():
    mean = [[[1.0], [0.0]]] * 4
    problem = SelectionProblem(np.eye(4), mean, np.zeros((4, 2, 1)), [0, 0.5])
    assert ms.solve(problem).choices.tolist() == [1, 1, 1, 1]
    limited = ms.solve(replace(problem, budget=1.0))
    assert problem.perception_term(limited.choices) == 1.0
    assert limited.multiplier == pytest.approx(1)  # a unit corrects two errors of 1, and costs 1
    assert limited.is_optimal
    loaded = replace(problem, switch_cost=[[0, 3], [3, 0]], initial_model=0)
    assert ms.solve(loaded).choices.tolist() == [0, 0, 0, 0]


def test_where_no_budget_binds_the_multiplier_of_a_relaxation_handed_over_is_0():
    mean = [[[1.0], [0.0]]] * 4
    problem = SelectionProblem(np.eye(4), mean, np.zeros((4, 2, 1)), [0, 0.5], budget=1.0)
    point = ms.relax_by_columns(problem)
    assert point.multiplier == pytest.approx(1)
    free = replace(problem, budget=None, switch_cost=[[0, 0.1], [0.1, 0]])
    for solver in (ms.round_and_swap, ms.dynamic_program, ms.branch_and_bound):
        assert solver(free, relaxation=point).multiplier == 0


def test_a_budget_that_nothing_keeps_is_told_what_would_do():
    mean = np.zeros((3, 2, 1))
    with pytest.raises(ValueError, match=r"^budget: .* at least 7\.5, .*found 7"):
        SelectionProblem(np.eye(3), mean, mean, [2.5, 4], switch_cost=[[0, 1], [1, 0]], budget=7.0)


@pytest.mark.parametrize("dear", [1e6, 1e13, np.inf])
def test_a_budget_is_as_tight_whatever_a_model_costs_that_nobody_can_afford(dear):
    """Also where the dear thing is a switch; the front keeps all its points."""
    mean = np.tile([[1.0], [0.0], [0.0]], (2, 1, 1))
    problem = SelectionProblem(np.eye(2), mean, 0 * mean, [0, 1, dear], budget=1.0, beta=0.0)
    switch = np.array([[0, 0, 0], [min(dear, 1e15), 0, 0], [0, 0, 0]])
    for pr in (problem, replace(problem, switch_cost=switch)):
        for solver in (ms.solve, ms.dynamic_program, ms.branch_and_bound, ms.enumerate_schedules):
            found = solver(pr)
            assert (found.cost, pr.perception_term(found.choices)) == (1.0, 1.0)
    with pytest.raises(ValueError, match="at least 0"):
        replace(problem, budget=-0.5)
    mean = np.tile([[2.0], [1.0], [0.0], [0.0]], (3, 1, 1))
    problem = SelectionProblem(np.eye(3), mean, 0 * mean, [0, 0.5, 1.25, dear])
    assert len(ms.pareto_front(problem)) == 7


def test_a_relaxation_without_time_for_a_mixture_spreads_each_step_over_its_models():
    price = np.array([[0, 1, np.inf], [0, 1, 2]])
    mean = np.ones((2, 3, 1))
    problem = SelectionProblem(np.eye(2), mean, mean, price, budget=1.0)
    point = relaxations.of_mixture(problem.form, None)
    np.testing.assert_allclose(point.weights, [[1 / 2, 1 / 2, 0], [1 / 3] * 3])
    assert point.bound == point.value == np.inf


def test_column_generation_ends_where_no_schedule_is_missing():
    """Also at an optimum of 0, which no relative gap ever reaches."""
    mean = np.tile([[2.0], [1.0], [0.0]], (3, 1, 1))
    problem = SelectionProblem(np.eye(3), mean, 0 * mean, [0, 1, 2], budget=5.5, beta=0.0)
    for budget in (6.0, 5.5, 3.0, 1.0):
        assert ms.relax_by_columns(replace(problem, budget=budget)).iterations <= 20


def test_a_refund_counts_among_the_sizes_of_what_is_spent():
    """Prices 0.3 and -0.3 sum to 0, or to a rounding: all orders of them are within a budget."""
    price = np.array([[0.1, 9], [0.2, 9], [-0.3, 9]])
    mean = np.tile([[0.0], [1.0]], (3, 1, 1))
    problem = SelectionProblem(np.eye(3), mean, 0 * mean, price, budget=0.0)
    assert ms.solve(problem).choices.tolist() == [0, 0, 0]
    assert (0.1 + 0.2) - 0.3 > 0


def test_a_lower_bound_by_word_alone_says_so():
    problem = a_problem(3)
    quick = ms.round_and_swap(problem)
    claimed = replace(quick, lower_bound=quick.cost)
    ms.check_certificate(problem, claimed)
    assert quick.root_bound < quick.cost
    assert claimed.is_optimal
    assert claimed.proof == "search"
    assert quick.proof == "root"


@pytest.mark.parametrize("relax", [ms.relax, ms.relax_interior_point])
def test_relaxations_over_single_models_refuse_arcs_and_budgets(relax):
    problem = SelectionProblem(np.eye(2), [[[1], [0]]] * 2, np.zeros((2, 2, 1)), [0, 1], budget=1)
    with pytest.raises(ValueError, match="relax_by_columns"):
        relax(problem)


@given(SEEDS)
def test_column_generation_meets_newtons_method_where_both_apply(seed):
    problem = replace(a_problem(seed), switch_cost=None, budget=None)
    columns, newton = ms.relax_by_columns(problem), ms.relax_interior_point(problem)
    d, M = np.abs(columns.reference), np.abs(problem.quadratic)
    # Certificates take off the rounding of all terms that they sum, which may cancel to 0.
    terms = d @ M @ d + 2 * np.abs(problem.mean).max(axis=1).ravel() @ M @ d
    terms += problem.linear_size.max(axis=1).sum()
    lent = trellis.lacking(problem.form, columns.reference).max(axis=1).sum()
    tiny = 1e-7 * abs(newton.value) + 1e-14 * terms + 10 * problem.rounding + lent
    assert columns.value - columns.bound <= tiny
    assert newton.bound - tiny <= columns.value <= newton.value + tiny
    assert columns.bound <= newton.value + tiny


@given(SEEDS)
def test_no_change_of_an_interval_improves_what_round_and_swap_returns(seed):
    problem = a_problem(seed)
    H, W, _ = problem.mean.shape
    if problem.form.arc is None:
        return
    schedule = ms.round_and_swap(problem)
    tiny = 10 * problem.rounding + 1e-12 * abs(schedule.cost)
    for a, b, w in itertools.product(range(H), range(H), range(W)):
        c = schedule.choices.copy()
        c[a : b + 1] = w
        if problem.is_feasible(c):
            assert problem.total_cost(c) >= schedule.cost - tiny


@given(SEEDS)
def test_correlated_cost_of_uncorrelated_errors_is_the_total_cost(seed):
    problem = a_problem(seed)
    c = ms.solve(problem).choices

    def white(t, w, k, v):
        return np.diag(problem.variance[t, w]) if t == k else np.zeros(2 * problem.mean.shape[2:])

    expected = pytest.approx(problem.total_cost(c), rel=1e-9, abs=1e-9)
    assert ms.correlated_cost(problem, c, white) == expected


@given(SEEDS)
def test_bias_and_noise_add_up_to_the_control_term_without_the_pull(seed):
    problem = replace(a_problem(seed), pull=None, budget=None)
    H, W, _ = problem.mean.shape
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    cost = ms.error_cost(a_problem(seed))
    np.testing.assert_allclose(cost.bias + cost.noise, problem.control_term(always), atol=1e-9)


@pytest.mark.parametrize(
    "feature", [{"budget": 1}, {"switch_cost": 1 - np.eye(2)}, {"pull": np.ones((2, 1))}]
)
def test_blends_refuse_what_they_do_not_have(feature):
    mean = np.zeros((2, 2, 1))
    problem = SelectionProblem(np.eye(2), mean, mean, [0, 1], **feature)
    with pytest.raises(ValueError, match=f"^problem: expected no {next(iter(feature))}"):
        ms.BlendProblem(problem)
