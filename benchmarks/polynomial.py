"""Time the polynomial cases of model selection over the horizon, and fit their growth.

Steps decouple without a forecast (``causal``), and one minimum a step is the optimum; a blend of
two models (Problem 4) is a convex programme over a box.  Both are timed on the textbook landing
with its suite of eight models, beside the decoder on the coupled problem, for which no polynomial
bound is known (the problem is NP-hard).  Exponents are slopes of log time against log H over the
longer half of the horizons, so that fixed costs of calling NumPy don't count.

    python benchmarks/polynomial.py [--quick]

prints a Markdown table and writes it to benchmarks/results/polynomial.md.  Run it with
OPENBLAS_NUM_THREADS=1 and nothing else on the machine.
"""

import argparse
import platform
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

import modelselect as ms
from landing import cost_scale, preset

RESULTS = Path(__file__).parent / "results" / "polynomial.md"
HORIZONS = {True: (50, 100, 200, 400), False: (50, 100, 200, 400, 800, 1600)}
DECODED = 400  # longest horizon at which the decoder is timed


def landing_problem(H, information):
    """The textbook landing in H steps, with its suite and price."""
    landing = preset("textbook", H)
    Psi, suite = ms.psi(landing.task, information), landing.draw_suite(np.random.default_rng(0))
    price = suite.cost * cost_scale(Psi, suite)
    return ms.SelectionProblem(Psi, suite.mean, suite.variance, price, alpha=0.8, beta=0.2)


def fresh(problem):
    """The same problem, without what it has already computed and kept."""
    copy = object.__new__(ms.SelectionProblem)
    for name in ("psi", "mean", "variance", "model_cost", "alpha", "beta"):
        object.__setattr__(copy, name, getattr(problem, name))
    return copy


def best_time(function, problem, repeats):
    """Least seconds of several runs, each on a fresh problem."""
    seconds = []
    for _ in range(repeats):
        argument = fresh(problem)
        started = perf_counter()
        function(argument)
        seconds.append(perf_counter() - started)
    return min(seconds)


def stepwise(problem):
    """The minima alone, where it is known that steps decouple: O(HW)."""
    return ms.stepwise_cost(problem).argmin(axis=1)


def blended(problem):
    """The certified optimum of Problem 4."""
    return ms.solve_blend(ms.BlendProblem(problem))


def exponent(horizons, seconds):
    """Slope of log time against log H over the longer half of the horizons."""
    known = [(H, t) for H, t in zip(horizons, seconds, strict=True) if t is not None]
    half = np.log(known[len(known) // 2 :])
    return float(np.polyfit(half[:, 0], half[:, 1], 1)[0]) if len(half) > 1 else float("nan")


def measure(horizons, repeats):
    """Seconds by column and horizon, and the gradient steps of the blends."""
    columns = {name: [] for name in ("minima", "solve_separable", "solve_blend", "solve")}
    steps = []
    for H in horizons:
        separable, coupled = (landing_problem(H, name) for name in ("causal", "preview"))
        columns["minima"].append(best_time(stepwise, separable, repeats))
        columns["solve_separable"].append(best_time(ms.solve_separable, separable, repeats))
        columns["solve_blend"].append(best_time(blended, coupled, repeats))
        decoded = best_time(ms.solve, coupled, 1) if H <= DECODED else None
        columns["solve"].append(decoded)
        steps.append(blended(coupled).iterations)
        print(f"H = {H} done", file=sys.stderr)
    return columns, steps


def table(horizons, columns, steps):
    """The measurements as Markdown."""
    heads = [
        "H",
        "minima alone (`stepwise_cost`)",
        "`solve_separable`",
        "`solve_blend`",
        "its gradient steps",
        "coupled: `solve`",
    ]

    def milliseconds(seconds):
        return "–" if seconds is None else f"{1000 * seconds:.2f}"

    lines = [heads, ["---:"] * len(heads)]
    for i, H in enumerate(horizons):
        times = [milliseconds(column[i]) for column in columns.values()]
        lines.append([str(H), *times[:3], str(steps[i]), times[3]])
    slopes = [f"H^{exponent(horizons, column):.1f}" for column in columns.values()]
    growth = exponent(horizons, steps)
    lines.append(["growth", *slopes[:3], f"H^{growth:.1f}", slopes[3]])
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="shorter horizons, fewer repeats")
    quick = parser.parse_args().quick
    horizons = HORIZONS[quick]
    columns, steps = measure(horizons, repeats=2 if quick else 5)
    text = f"""# The polynomial cases

Milliseconds on the textbook landing, W = 8, p = 1; the least of {2 if quick else 5} runs
(`solve`: one run). Without a forecast (`causal`) one minimum a step is the optimum; a blend of b0
and b7 (`preview`) is a convex programme; the coupled problem (`preview`) is NP-hard and stands
here for comparison. Growth: slope of log time over the longer half of the horizons.

{table(horizons, columns, steps)}

The minima grow with H·W. `solve_separable` also makes sure that Ψ, a dense (H, H) array, couples
no steps, which takes H² operations (and longer once Ψ outgrows the cache); a blend takes H²
operations a gradient step, and H³ once for the step length.

Python {platform.python_version()}, NumPy {np.__version__}, {platform.machine()}.
"""
    print(text)
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
