# ruff: noqa: E501  (one row a line)
"""Which test holds which public function against an oracle that shares no code with it.

Of several such tests the table names the strictest.  A new function needs a row, and so a test.
"""

import inspect
from functools import cached_property
from pathlib import Path

import pytest
from test_paper import written_tests

import landing
import modelselect as ms
import perception

from strategies import belongs

pytestmark = pytest.mark.no_cover

#: file, and below it: public names | test | what the oracle is
ORACLES = """
tests/test_control.py
ControlTask ControlTask.n ControlTask.m ControlTask.p | test_a_task_knows_its_dimensions | arrays of known sizes
ControlTask.over_time | test_matrices_over_time_are_those_of_each_step | picking each step's matrix by hand
riccati | test_p_is_the_optimal_cost_to_go_found_by_least_squares | stacked matrices and least squares
plan | test_the_plan_is_that_of_the_dense_formula | stacked matrices and a dense solve
run_controller | test_causal_plans_anew_with_this_estimate_and_the_prior_mean_after_it | dense planning anew at every step
control_cost | test_the_control_cost_is_the_sum_over_x1_to_xh_and_u0_to_uh_minus_1 | the definition, index by index
tests/test_psi.py
psi preview_regret | test_psi_is_the_regret_of_a_robot_that_plans_anew_by_dense_algebra | dense planning, a plain roll-out and cost
tests/test_filter.py
kalman_gains | test_gains_that_vary_give_the_conditional_mean_of_a_gaussian | dense conditioning of a joint Gaussian
prior_pull | test_the_pull_of_a_misjudged_start_is_what_the_observer_pays_with_it | an observer in plain loops, planning densely
tests/test_problem.py
as_numbers check_array check_number check_count check_information check_choices shown | test_the_checkers_by_hand | values and messages by hand
check_semidefinite | test_semidefinite_is_what_sylvesters_minors_say_in_whole_numbers | principal minors in whole numbers
one_hot from_one_hot | test_one_hot_marks_the_chosen_model_and_from_one_hot_reads_it | a plain loop over models
SelectionProblem SelectionProblem.control_term | test_the_control_term_is_the_exact_mean_over_two_point_errors | mean over all two-point errors
SelectionProblem.total_cost | test_the_total_is_the_sum_over_single_steps_and_over_pairs_of_steps | plain loops over steps and components
SelectionProblem.perception_term | test_the_perception_term_adds_the_cost_of_the_chosen_models | a plain sum over steps
SelectionProblem.chosen_mean | test_the_stacked_mean_holds_component_r_of_step_t_at_t_p_plus_r | a plain loop over components
SelectionProblem.linear | test_linear_is_the_weighted_trace_plus_the_weighted_cost | a trace for each step
SelectionProblem.quadratic SelectionProblem.blocks SelectionProblem.spread stepwise_cost | test_quadratic_blocks_spread_and_stepwise_cost_are_those_of_loops | plain loops over components
SelectionProblem.rounding SelectionProblem.linear_size SelectionProblem.cost_rounding | test_rounding_is_relative_to_the_sizes_of_the_terms_that_the_greedy_choices_sum | plain loops over terms
SelectionProblem.exact_cost | test_a_cost_is_off_by_its_rounding_at_most | fractions of the very floats
Schedule Schedule.gap | test_the_gap_is_relative_to_the_larger_of_cost_and_bound | values worked out by hand
Schedule.is_optimal | test_a_schedule_is_optimal_up_to_a_relative_gap_of_1e_9 | hand values on either side
reference_bound | test_a_small_problem_and_its_bound_by_hand | two steps worked out by hand
check_certificate | test_a_certificate_by_hand_is_accepted | a certificate worked out by hand
is_separable | test_separable_is_where_no_two_mean_errors_meet_at_different_steps | loops over pairs of mean errors
tests/test_edges.py
enumerate_schedules plain_dynamic_program dynamic_program branch_and_bound solve | test_an_exact_solver_finds_and_proves_the_optimum | enumeration in exact fractions
solve_separable | test_separable_edges_are_solved_step_by_step | enumeration in exact fractions
round_and_swap | test_round_and_swap_is_between_its_bound_and_no_better_than_the_optimum | all swaps in exact fractions
tests/test_solvers.py
Relaxation.gap | test_the_gap_of_a_relaxation_is_zero_where_value_and_bound_meet | values worked out by hand
project_to_simplex | test_projection_is_the_nearest_point_of_the_simplex | angles to all vertices (variational inequality)
projected_gradient | test_projected_gradient_meets_bounded_least_squares | SciPy's bounded least squares
relax relax_interior_point | test_relaxations_agree_with_a_general_convex_solver | cvxpy with Clarabel
tests/test_sound.py
SelectionProblem.defect | test_what_a_matrix_lacks_of_being_semidefinite_is_found_or_bounded | elimination in fractions
tests/test_long_horizon.py
sensitivity Sensitivity.diagonal Sensitivity.blocks Sensitivity.coupled Sensitivity.order | test_a_system_is_its_matrix | the dense matrix
tests/test_besides.py
with_dropouts | test_dropouts_have_the_moments_of_errors_that_are_dropped_by_hand | errors dropped by hand
with_latency | test_an_estimate_that_is_late_errs_by_what_the_input_walked | a simulated random walk
measured_latency | test_measured_latencies_are_prices_that_grow_faster_than_the_models_number | the published tables
Kernel | test_a_kernel_is_a_plain_weighted_mean | a plain loop over residuals
tests/test_on_board.py
receding_horizon | test_who_learns_nothing_new_does_not_change_the_plan_for_a_dearer_one | the best of all schedules
tests/test_constrained.py
relax_by_columns | test_column_generation_meets_newtons_method_where_both_apply | the interior point
pareto_front | test_the_front_is_that_of_all_schedules | the front of all schedules
Schedule.proof | test_a_lower_bound_by_word_alone_says_so | a bound put in by hand
SelectionProblem.form SelectionProblem.is_feasible | test_terms_are_the_sums_that_the_definition_writes | plain sums over steps
tests/test_theory.py
error_cost | test_the_error_cost_splits_the_control_term_of_running_one_model | plain loops over second moments
correlated_cost | test_correlated_cost_is_the_exact_average_over_correlated_draws | average over all correlated draws
BlendProblem BlendProblem.total_cost | test_a_blend_costs_the_expectation_under_its_mean_variance_and_price | the expectation, entry by entry
BlendProblem.quadratic BlendProblem.linear BlendProblem.constant | test_the_canonical_form_holds_the_coefficients_of_the_expectation | probing the expectation with unit steps
solve_blend | test_the_solver_of_blends_meets_a_general_qp_solver | cvxpy's quadratic programme with Clarabel
sdp_blocks | test_an_sdp_solver_on_our_blocks_meets_a_qp_solver_on_the_definition | cvxpy's semidefinite against quadratic programme
partition_problem | test_the_optimum_of_the_gadget_is_that_of_a_table_over_signed_sums | a table of all signed sums
maximum_cut_problem | test_the_cheapest_schedule_is_a_maximum_cut | all cuts of random graphs
tests/test_correlated.py
correlated_problem | test_every_schedule_costs_what_all_draws_cost_on_average | average over all correlated draws
persistent_bias | test_a_persistent_bias_has_the_covariance_of_its_draws | products of sampled errors
autoregressive_errors | test_autoregressive_errors_have_the_covariance_of_their_recursion | products of errors sampled by recursion
tests/test_held.py
hold expand_choices | test_every_schedule_costs_and_spends_what_the_one_that_repeats_it_does | the unheld problem, choices repeated by hand
tests/test_perception.py
PerceptionSuite | test_a_suite_holds_what_it_was_given | the arrays given, by hand
PerceptionSuite.pick | test_picked_models_keep_their_entries | a plain loop over models
published_suite | test_published_suite_has_the_published_averages | moments of uniform draws by hand
gaussian_suite | test_gaussian_suite_evaluates_its_formulas | a plain loop over formulas
textbook_suite | test_textbook_suite_follows_its_formulas | the printed formulas and their jitter
sample_errors | test_sampled_errors_have_the_moments_of_the_suite | exact covariances, six standard errors
check_rng | test_sample_errors_refuses | messages written by hand
with_bar | test_perception_stands_on_numpy_and_scipy_alone | a Python that finds nothing else
ModelTable | test_the_efficientnet_table | the table as published
Residuals read_residuals write_residuals | test_the_file_format | lines of text by hand
fit_suite | test_fit_equals_a_plain_loop | a plain loop, to the last bit
tests/test_measured.py
report_measured | test_regret_is_that_of_psi_where_errors_are_the_same_everywhere | e'Psi e by hand
tests/test_plants.py
nearest_semidefinite | test_the_nearest_semidefinite_matrix_is_nearer_than_any_other | other semidefinite matrices
tests/test_measurements.py
Residuals.missed | test_a_file_says_the_same_however_it_was_written | empty cells of files written by hand
tests/test_camera.py
bootstrap_errors | test_bootstrapped_errors_are_residuals_of_their_bin_with_their_moments | residuals sorted by hand, their moments
guard_suite | test_guards_fade_with_many_residuals_and_have_the_textbook_factors | printed tables of quantiles
altitude_bins | test_bins_hold_equally_many_altitudes | counting with a histogram
draw_pose draw_scenes | test_scenes_are_drawn_from_the_stated_distributions | Kolmogorov-Smirnov against the stated laws
draw_views | test_views_are_spread_evenly_over_the_logarithm_of_distance | Kolmogorov-Smirnov against the stated laws
photograph | test_pictures_are_those_of_a_ray_tracer | a ray tracer with soft edges
Network.parameters Network.multiply_adds | test_parameters_and_operations_are_those_of_the_arrays | counting windows and weights by hand
Network.altitude | test_altitudes_are_those_of_plain_loops | loops over windows in double precision
new_network | test_new_weights_are_normal_with_variance_two_over_inputs | Kolmogorov-Smirnov against normal draws
forward | test_forward_equals_plain_loops | loops over windows in double precision
gradients | test_gradients_equal_finite_differences | finite differences of the loss
train_network | test_training_is_adam_by_differences | Adam as printed, slopes by differences
train_models measure_models | test_residuals_are_what_loops_see_in_pictures_that_were_held_out | loops over windows of held-out pictures
pack_models load_models | test_the_file_is_a_plain_npz_of_named_arrays | NumPy's own reader and writer
tests/test_landing.py
preset | test_textbook_dynamics_are_ellert_and_merriams_held_exactly | the printed coefficients and SciPy's exponential
cost_scale | test_the_price_of_two_models_by_hand | two models worked out by hand
Settings | test_settings_are_checked | messages written by hand
Result.means | test_means_are_sums_over_trials | exact sums over trials
policies | test_schedules_of_the_simple_policies | loops over models and steps
fly | test_trials_are_those_of_a_robot_that_plans_anew_by_dense_algebra | dense planning, a plain roll-out and cost
run_experiment | test_flown_costs_agree_with_the_problem | expected costs through Psi against roll-outs
pareto | test_no_schedule_is_better_in_both_than_the_front | enumeration of all schedules
whole_front | test_all_points_are_those_that_no_schedule_beats_and_corners_those_that_weights_reach | enumeration of all schedules and ratios
plot_front | test_front_figure_shows_corners_points_between_and_constants | constants by hand, read off the figure
published_log | test_logged_rewards_are_those_that_the_authors_print | the authors' printed log
half_width | test_intervals_are_students | a printed table of Student's t
percentages | test_percentages_are_shares_of_the_old_mean | means of the standard library
write_percentages | test_the_file_of_percentages_holds_the_rows | the standard library's reader
report | test_report_prints_means_and_intervals | the standard library's statistics, printed text read back
summary | test_summary_has_the_promised_keys | plain means of the trials
plot_schedule | test_schedule_figure_shows_the_schedule | the schedule itself, read off the figure
plot_costs plot_rewards | test_cost_and_reward_figures_show_the_means | the means, read off the figures
plot_pareto | test_pareto_figure_shows_the_front_and_the_policies_in_expectation | plain loops, read off the figure
plot_landing | test_landing_figure_shows_mean_and_band_over_seconds | sorted trials, read off the figure
plot_efficientnet | test_efficientnet_figure_shows_the_table | the published table, read off the figure
plot_psi | test_psi_figure_has_one_scale_and_four_patterns | Psi itself, read off the figure
write_figures | test_same_seed_same_files | each figure saved by Matplotlib
write_atomically | test_a_file_is_written_with_its_folder_and_nothing_else | bytes read back, folder listed
check_targets | test_bad_input_is_one_line_and_status_2_and_leaves_nothing | paths and messages by hand
main | test_command_line_prints_and_writes | the run called from Python
tests/test_trained.py
model_cost | test_counted_costs_by_hand | counting windows times weights by hand
fit_landing | test_a_suite_along_the_landing_is_that_of_loops_and_textbook_bounds | loops over steps and SciPy's quantiles
learn | test_what_is_learned_is_what_training_makes_of_the_first_stream_of_the_seed | training called by hand
fly_on_pictures | test_flights_are_those_of_the_controller_fed_the_same_errors | the controller fed the same errors
judge_on_pictures | test_flown_regret_is_that_of_the_controller_fed_what_the_networks_made_of_it | two roll-outs, with and without errors
sample_sizes | test_regret_of_all_residuals_is_that_of_loops_over_steps | loops over steps, each solved alone
report_pictures | test_the_report_on_pictures_prints_what_it_was_told | hand values, printed text read back
root_mean_square | test_root_mean_square_covers_the_truth | coverage of a known truth
plot_accuracy | test_accuracy_figure_shows_root_mean_squares_over_parameters | plain means, read off the figure
plot_distribution | test_distribution_figure_shows_errors_their_mean_and_deviation | sorted errors, read off the figure
plot_training | test_training_figure_shows_roots_of_losses_in_logarithms_of_distance | plain roots, read off the figure
plot_quantiles | test_quantile_figure_shows_standardised_errors_over_normal_quantiles | the standard library's normal quantiles
plot_gallery | test_gallery_shows_three_landings_and_the_third_again_at_40_pixels | one picture against the other, resized
tests/test_learning.py
fly_stages | test_flown_stages_are_flights_of_each_schedule_by_what_then_reads | each flight by itself, with and without errors
plot_stages | test_the_figure_shows_estimates_of_every_stage | means of flights, read off the figure
"""
#: Records without behaviour of their own, and the function that fills them.
RECORDS = {
    **{
        "Riccati": "riccati",
        "Pattern": "psi",
        "Sensitivity": "sensitivity",
    },
    **{"Relaxation": "relax", "Node": "branch_and_bound"},
    **{"ErrorCost": "error_cost", "Blend": "solve_blend", "Scene": "draw_scenes"},
    **{"Layer": "new_network", "Network": "new_network", "Trained": "train_models"},
    **{"Preset": "preset", "Flights": "run_experiment", "Result": "run_experiment"},
    **{"Regret": "judge_on_pictures", "Front": "whole_front"},
}


def public(module):
    """Names of what a module defines: functions, classes, their methods and properties."""
    for name, thing in vars(module).items():
        if not belongs(name, thing, module):
            continue
        if callable(thing):
            yield name
        for key, member in vars(thing).items() if inspect.isclass(thing) else ():
            kinds = isinstance(member, property | cached_property) or inspect.isfunction(member)
            if kinds and key[0] != "_":
                yield f"{name}.{key}"


@pytest.mark.unmutated
def test_every_public_callable_has_one_oracle_and_every_oracle_a_test():
    path, listed = "", []
    for line in ORACLES.strip().splitlines():
        if "|" not in line:
            path, known = line, written_tests(Path(line))
            continue
        names, test, oracle = line.split(" | ")
        assert test in known, f"{path}: no test {test}"
        assert 3 <= len(oracle.split()) <= 8, oracle
        listed += names.split()
    assert set(RECORDS.values()) <= set(listed)
    found = [name for module in (ms, perception, landing) for name in public(module)]
    assert sorted([*listed, *RECORDS]) == sorted(found)  # each exactly once
