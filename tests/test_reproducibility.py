"""The same seed gives the same numbers with every supported NumPy and SciPy.

`make test` runs this with the newest versions and `make test-oldest` with the oldest: both have to
agree with one table.  The numbers are no oracle (other tests have those), only a memory.
"""

import pytest

from landing import Settings, run_experiment, summary

pytestmark = pytest.mark.no_cover

# (preset, information): lower bound of the optimum, control costs of Oracle, Optimal and Random
MEMORY = {
    (
        "published",
        "open_loop",
    ): "1.1693767594e15 3.7745399061e15 4.6360346514e15 4.0426094406e15",
    ("published", "preview"): "1.7015421254e13 3.7745399061e15 3.7958361830e15 3.7793836417e15",
    ("published", "causal"): "2.7079898838e12 3.7745399061e15 3.7779290850e15 3.7756808262e15",
    (
        "published",
        "measurement",
    ): "2.7247935734e12 3.7745399061e15 3.7779496387e15 3.7756869354e15",
    ("textbook", "open_loop"): "1.9467479280e3 6.8805903642e1 9.1373863599e2 2.8860369177e3",
    ("textbook", "preview"): "5.9330039167e1 6.8805903642e1 9.0641085775e1 1.7979139628e2",
    ("textbook", "causal"): "9.5387477674e0 7.3524292429e1 7.7725170608e1 9.8241895091e1",
    ("textbook", "measurement"): "9.5387477674e0 7.5500568028e1 8.0292473835e1 1.0134015967e2",
}


@pytest.mark.parametrize("preset, information", MEMORY)
def test_every_version_gives_the_same_costs(preset, information):
    settings = Settings(preset=preset, information=information, horizon=40, trials=3)
    found = summary(run_experiment(settings))
    costs = [found["policies"][who]["control_cost"] for who in ("Oracle", "Optimal", "Random")]
    memory = [float(number) for number in MEMORY[preset, information].split()]
    assert [found["lower_bound"], *costs] == pytest.approx(memory, rel=1e-9)
