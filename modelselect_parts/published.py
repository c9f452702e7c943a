"""What the authors logged of their two experiments, and what the paper prints of it."""

#: Means of 100 trials that the authors logged of experiment 1, and of 2: control cost, and
#: perception cost in Upsilon at w + 1 for model w.
LOGGED = {
    "Oracle": ((5.189117e15, 0), (5.189117e15, 0)),
    "Optimal": ((7.299417e15, 628), (5.200365e15, 664)),
    "Random": ((4.871516e16, 664), (7.178464e15, 670)),
    "All Large": ((5.190354e15, 1200), (5.924078e15, 1200)),
    "All Small": ((4.915508e17, 150), (1.885632e16, 150)),
}
EXPERIMENT_1, EXPERIMENT_2 = ({policy: row[k] for policy, row in LOGGED.items()} for k in (0, 1))
#: Quantity, new, old; what the paper prints of (new - old) / |old| in experiment 1, and in 2.
COMPARISONS = (
    ("control_cost", "Optimal", "Random", "", ""),
    ("control_cost", "Random", "Optimal", "567.18% lower", "38.04% lower"),
    ("perception_cost", "Optimal", "Random", "", ""),
    ("perception_cost", "All Large", "Random", "80.72% less", "79.1% less"),
    ("reward", "Optimal", "Random", "", ""),
    ("control_cost", "Optimal", "All Large", "", ""),
    ("perception_cost", "Optimal", "All Large", "", ""),
    ("reward", "Optimal", "All Large", "", ""),
    ("reward", "All Large", "Optimal", "53.26% better", "13.97% better"),
    ("reward", "Oracle", "Optimal", "77% far from Oracle", "0.3% far from Oracle"),
)
