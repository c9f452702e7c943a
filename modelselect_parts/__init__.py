"""What the three modules stand on; each room uses only rooms above it.

================= ==============================================================================
objects           objects that nobody can change; checks of classes and names
semidefinite      semidefinite matrices up to MATRIX_TOLERANCE: judged, mended, factored
checks            the one checker of arguments, the types of array
matrices          covariances and cost matrices as users give them
stored            objects as JSON and back
files             files that are written whole or not at all
options           options of a command line
exact             floats in exact numbers
task              paper II: the task, what a flight costs, its Riccati recursion
regulator         paper II: the controllers, what each of them knows, and Psi
observers         gains of a Kalman filter
sensitivity       Psi as a linear system, for horizons of which no matrix is written down
trellis           the certificate LB(d, lam), less rounding, on bare arrays: `certificate`
problem           paper III: which model to run at each step; `form` hands it to the engines,
                  switches as arc and toll, a budget as price and limit
schedule          a schedule with its proof; OPTIMALITY_GAP
error_costs       what single models cost
held              choices that hold for several steps
covariances       errors that correlate over time: persistent biases, AR(1)
correlated        what such errors cost, and the problem that they pose
hardness          why it is hard: PARTITION and MAXIMUM CUT as model selection
descent           projected gradient with its duality gap
interior_point    the fast relaxation, on bare arrays
column_generation the relaxation where switching costs or a budget tie steps together
local_search      better schedules by small changes
triangle          what a schedule costs beyond its bound, as a sum over steps; `purse`: what it
                  spends ("budget" alone is, in searches, what labels may cost beyond the bound)
dominance         which partial schedules others make superfluous
label_search      the exact search, on bare arrays
ahead             what the steps ahead of a partial schedule add, and how soon they forget it
long_horizon      windows of a long horizon; which passes a search takes
relaxations       the relaxation, by the engine that is fastest for it
passes            the exact search pass by pass; the price of a budget
blends            paper V: Problem 4
suites            how models err, step by step; dropouts, latency
measurements      measured errors as a table of rows
residual_files    such tables in CSV files: `read_residuals` names every fault and its line
kernels           residuals weighed by how near they were made
doubts            what a fit warns of
residuals         what to expect of them: fitted, guarded, drawn from
camera            pictures of a helipad
networks          small networks and how they learn
figures           every picture, from arrays (which: plots)
tables            every table that is printed, from arrays (which: `landing.report`)
published         what the authors logged, and the paper prints
prices            what models cost
rivals            whom the optimum is compared with: eight policies, the sweep of weights
pooling           errors of networks pooled by distance; networks calibrated
sight             landing by what networks see in pictures
flights           flights with errors out of a table and by sight, and what they differ by
learning          rounds of landings that are labelled; what each stage is worth
measured          landing on errors that real programs made
plots             which arrays of a run each picture takes
================= ==============================================================================
"""
