"""What models cost: a constant more each, counted operations, or measured milliseconds.

The first two are in a unit Upsilon, of which the dearest of W models costs W - 1.  Milliseconds
stay what they are, so that switches and a budget are milliseconds too; they weigh what makes the
dearest model as dear as it is in the first two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modelselect_parts.checks import Array, check_classes, check_name
from perception import EFFICIENTNET, Network, PerceptionSuite, measured_latency

#: What model w costs, in words.
COSTS = {
    "linear": "w * Upsilon",
    "counted": "operations, b7 at 7 Upsilon",
    "latency": "ms of EfficientNet on an i7-12700H",
}
#: What perception costs are measured in, beside control costs.
UNITS = {"linear": "", "counted": "", "latency": "ms"}
PROCESSOR = "efficientnet-i7-12700H"  # of the tables of `measured_latency`


def model_cost(networks: Sequence[Network], cost: str) -> Array:
    """Return the costs (W,) of networks: w, operations, or milliseconds.

    As `cost` is ``linear``; ``counted``: the multiply-adds times (W-1) / the largest; ``latency``:
    those of the EfficientNets of the same numbers.
    """
    check_classes("networks", networks, "Network")
    check_name("cost", cost, COSTS)
    counted = np.array([float(network.multiply_adds) for network in networks])
    W = len(counted)
    if cost == "latency":
        return latency([f"b{w}" for w in range(W)])
    return (W - 1) * counted / counted.max() if cost == "counted" else np.arange(float(W))


def latency(names: Sequence[str]) -> Array:
    """Return the milliseconds (W,) that EfficientNets of these `names` take for a picture."""
    known = dict(zip(EFFICIENTNET.names, measured_latency(PROCESSOR), strict=True))
    for name in names:
        check_name("names", name, known)
    return np.array([known[name] for name in names])


def priced(suite: PerceptionSuite, upsilon: float, cost: str) -> tuple[PerceptionSuite, float]:
    """Return a suite with its costs at `upsilon`, and what a unit of them weighs.

    Costs in Upsilon are multiplied and weigh 1.  Of `cost` ``latency``, they stay, and weigh
    (W-1) upsilon / the largest of an available model.
    """
    if cost == "latency":
        return suite, upsilon * (len(suite.names) - 1) / float(
            suite.cost[np.isfinite(suite.cost)].max()
        )
    return replace(suite, cost=suite.cost * upsilon), 1.0
