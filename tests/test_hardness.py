"""Why selection is hard: two problems that hide PARTITION and MAX-CUT, against brute force.

The oracles know neither Psi nor a solver: they try every split of a graph and of integers.
"""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

import modelselect as ms

PATTERNS = ("open_loop", "preview")
both_patterns = pytest.mark.parametrize("information", PATTERNS)


def random_graph(rng, nodes=None):
    """A symmetric matrix of zeros and ones, from no edge to all of them."""
    nodes = int(rng.integers(1, 9)) if nodes is None else nodes
    edges = np.triu(rng.random((nodes, nodes)) < rng.choice([0.2, 0.5, 0.8]), 1)
    return (edges | edges.T).astype(float)


def cycle(nodes):
    step = np.roll(np.eye(nodes), 1, axis=0)
    return np.minimum(step + step.T, 1) * (1 - np.eye(nodes))


GRAPHS = {
    "one node": np.zeros((1, 1)),
    "two nodes, apart": np.zeros((2, 2)),
    "two nodes, joined": np.ones((2, 2)) - np.eye(2),
    "no edge": np.zeros((6, 6)),
    "complete": np.ones((7, 7)) - np.eye(7),
    "odd cycle": cycle(7),
    "even cycle": cycle(8),
    "star": np.pad(np.ones((1, 7)), ((0, 7), (1, 0))) + np.pad(np.ones((7, 1)), ((1, 0), (0, 7))),
    **{f"random {i}": random_graph(np.random.default_rng([6, i])) for i in range(16)},
}
every_graph = pytest.mark.parametrize("name", GRAPHS)


def cut(adjacency, side):
    """Edges between the two sides, counted one by one."""
    pairs = [(i, j) for i in range(len(side)) for j in range(i) if side[i] != side[j]]
    return sum(int(adjacency[i, j]) for i, j in pairs)


def splits(nodes):
    """All ways to put each node on one of two sides."""
    return list(product((0, 1), repeat=nodes))


def graph_errors(problem):
    """The errors of a schedule's steps, (H, W): one for each side."""
    assert problem.mean.shape[1:] == (2, 1)
    return problem.mean[:, :, 0]


# ---------------------------------------------------------------------------------- MAX-CUT


@every_graph
@both_patterns
def test_the_optimal_schedule_is_a_maximum_cut(information, name):
    adjacency = GRAPHS[name]
    found = ms.solve(ms.maximum_cut_problem(adjacency, information))
    assert found.is_optimal
    largest = max(cut(adjacency, side) for side in splits(len(adjacency)))
    assert cut(adjacency, found.choices) == largest


@every_graph
@both_patterns
def test_every_schedule_costs_what_its_cut_says_and_less_than_a_half_more(information, name):
    """eps'Psi eps = H (2 H^2 - 4 cut) - H + eps'(I + HM)^{-1} eps, the last in (0, 1/2)."""
    adjacency, H = GRAPHS[name], len(GRAPHS[name])
    problem = ms.maximum_cut_problem(adjacency, information)
    for side in splits(H):
        rest = problem.total_cost(side) - (H * (2 * H**2 - 4 * cut(adjacency, side)) - H)
        assert 0 < rest < 0.5


@every_graph
def test_the_cost_beyond_the_cut_is_that_of_the_inverse_in_fractions(name):
    """The last term by Gauss and Jordan: no floating-point number is in the way."""
    adjacency, H = GRAPHS[name], len(GRAPHS[name])
    laplacian = np.diag(adjacency.sum(axis=1)) - adjacency
    M = np.eye(H) + H * (2 * H * np.eye(H) - laplacian)
    rows = np.concatenate([M, np.eye(H)], axis=1).astype(int).astype(object) * Fraction(1)
    for i in range(H):
        rows[i] = rows[i] / rows[i, i]
        for r in range(H):
            if r != i:
                rows[r] = rows[r] - rows[r, i] * rows[i]
    inverse = rows[:, H:]
    problem = ms.maximum_cut_problem(adjacency)
    for side in splits(H)[:: max(1, 2**H // 32)]:
        sign = np.array([1 - 2 * w for w in side], dtype=object)
        value = H * (2 * H**2 - 4 * cut(adjacency, side)) - H + sign @ inverse @ sign
        assert abs(problem.total_cost(side) - value) <= 1e-12 * 2 * H**3


@every_graph
def test_both_patterns_have_the_same_psi(name):
    adjacency, H = GRAPHS[name], len(GRAPHS[name])
    one, other = (ms.maximum_cut_problem(adjacency, information) for information in PATTERNS)
    np.testing.assert_allclose(one.psi, other.psi, rtol=0, atol=1e-13 * 2 * H**2)
    laplacian = np.diag(adjacency.sum(axis=1)) - adjacency
    HM = H * (2 * H * np.eye(H) - laplacian)
    exact = HM @ np.linalg.inv(np.eye(H) + HM) @ HM
    np.testing.assert_allclose(one.psi, exact, rtol=0, atol=1e-12 * 2 * H**2)


@both_patterns
def test_the_two_models_err_by_one_either_way_and_cost_nothing(information):
    problem = ms.maximum_cut_problem(cycle(5), information)
    assert (np.sort(graph_errors(problem), axis=1) == [-1, 1]).all()
    assert (graph_errors(problem) == graph_errors(problem)[0]).all()  # a model is a side
    assert not problem.variance.any() and not problem.model_cost.any()
    assert (problem.alpha, problem.beta) == (1, 1)


def test_open_loop_is_the_default():
    found, stated = (ms.maximum_cut_problem(cycle(4), *rest) for rest in ((), ("open_loop",)))
    assert (found.psi == stated.psi).all()


def test_a_larger_cut_is_cheaper_by_more_than_what_is_beyond_the_cut():
    """Numbers stay polynomial in H, as strong hardness needs: at most 2 H^3 + 1/2."""
    for i in range(10):
        adjacency = random_graph(np.random.default_rng([8, i]))
        problem, H = ms.maximum_cut_problem(adjacency), len(adjacency)
        costs = {side: problem.total_cost(side) for side in splits(H)}
        order = sorted(costs, key=costs.get)
        cuts = [cut(adjacency, side) for side in order]
        assert cuts == sorted(cuts, reverse=True)
        assert max(costs.values()) <= 2 * H**3


@both_patterns
def test_relabelled_nodes_give_the_same_optimum(information):
    rng = np.random.default_rng(9)
    adjacency, order = random_graph(rng, 7), rng.permutation(7)
    one, other = (
        ms.solve(ms.maximum_cut_problem(graph, information))
        for graph in (adjacency, adjacency[np.ix_(order, order)])
    )
    assert one.cost == pytest.approx(other.cost, rel=1e-12)


@pytest.mark.parametrize(
    "adjacency",
    [
        np.zeros((2, 3)),
        np.zeros(4),
        np.zeros((0, 0)),
        np.zeros((1, 2, 2)),
        [[0, 1], [0, 0]],
        [[0, 1, 0], [1, 0, 1], [1, 1, 0]],
        [[1, 1], [1, 0]],
        np.eye(3),
        [[0, 2], [2, 0]],
        [[0, -1], [-1, 0]],
        [[0, 0.5], [0.5, 0]],
        [[0, np.nan], [np.nan, 0]],
        [[0, np.inf], [np.inf, 0]],
        [["a", "b"], ["b", "a"]],
        [[0, 1], [1]],
        None,
    ],
)
def test_what_is_no_graph_is_refused_in_one_line(adjacency):
    for rest in ((), ("preview",)):
        with pytest.raises(ValueError, match=r"^adjacency: ") as error:
            ms.maximum_cut_problem(adjacency, *rest)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("information", ["causal", "measurement", "sideways", None])
def test_a_pattern_in_which_steps_do_not_meet_is_refused(information):
    for make in (
        lambda: ms.maximum_cut_problem(cycle(4), information),
        lambda: parted(information),
    ):
        with pytest.raises(ValueError, match=r"^information: ") as error:
            make()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", [bool, int, np.uint8, np.float32, list])
def test_a_graph_may_be_of_any_numbers(kind):
    graph = cycle(5)
    given = graph.astype(int).tolist() if kind is list else graph.astype(kind)
    assert (ms.maximum_cut_problem(given).psi == ms.maximum_cut_problem(graph).psi).all()


# -------------------------------------------------------------------------------- PARTITION


def parted(information):
    return ms.partition_problem([3, 1, 1, 2, 2, 1], information)


@both_patterns
@pytest.mark.parametrize("H", [1, 2, 3, 7])
def test_psi_of_the_partition_gadget_is_a_half_everywhere(H, information):
    """Only the first control acts, in both patterns: x_H = u_0 + sum of s, R = Q_final = 1."""
    found = ms.partition_problem([2] * H, information).psi
    np.testing.assert_allclose(found, np.full((H, H), 0.5), rtol=0, atol=1e-15)


def test_the_partition_gadgets_of_both_patterns_are_one_problem():
    one, other = (parted(information) for information in PATTERNS)
    np.testing.assert_allclose(one.psi, other.psi, rtol=0, atol=1e-15)
    for field in ("mean", "variance", "model_cost"):
        assert (getattr(one, field) == getattr(other, field)).all()
    assert (one.alpha, one.beta) == (other.alpha, other.beta)


@both_patterns
@pytest.mark.parametrize("seed", range(12))
def test_the_optimum_is_below_a_half_exactly_if_the_integers_split_evenly(seed, information):
    rng = np.random.default_rng([10, seed])
    integers = rng.integers(1, 12, rng.integers(2, 9)).tolist()
    least = min(abs(sum(integers) - 2 * sum(half)) for half in halves(integers))
    found = ms.solve(ms.partition_problem(integers, information))
    assert found.is_optimal
    assert (found.cost < 0.5) == (least == 0)
    signs = 1 - 2 * found.choices
    assert abs((signs * integers).sum()) == least


def halves(integers):
    """All sub-lists."""
    for take in product((False, True), repeat=len(integers)):
        yield [a for a, taken in zip(integers, take, strict=True) if taken]
