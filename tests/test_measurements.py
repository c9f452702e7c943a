"""Files of residuals, good and bad, and what is asked of rows before anybody trusts them."""

import csv
import math
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import perception
from modelselect import SelectionProblem
from modelselect_parts import residual_files
from perception import (
    Kernel,
    PerceptionSuite,
    Residuals,
    altitude_bins,
    bootstrap_errors,
    fit_suite,
    gaussian_suite,
    guard_suite,
    read_residuals,
    with_dropouts,
    write_residuals,
)

SEEDS = st.integers(0, 2**32 - 1)
FOLDER = Path(__file__).parent / "csv"
ALSO = " (or model, variables, and columns that begin with residual)"
BAD = {  # what stands where, and is not what it should be
    "underscores": "line 3: expected a model and two finite numbers, found 'a,2_0,1'",
    "underscored_thousands": "line 3: expected a model and two finite numbers, found 'a,2,1_000'",
    "full_width_digits": "line 3: expected a model and two finite numbers, found 'a,２０,1'",
    "arabic_digits": "line 3: expected a model and two finite numbers, found 'a,٢٠,1'",
    "nan": "line 3: expected a model and two finite numbers, found 'a,2,nan'; where a model gave "
    "nothing, leave its residuals empty",
    "quoted_comment": """line 3: expected a model and two finite numbers, found '"#1",2,1'""",
    "comment_before": "line 5: expected a model and two finite numbers, found 'a,2,x'",
    "infinity": "line 3: expected a model and two finite numbers, found 'a,2,-inf'",
    "too_large": "line 3: expected a model and two finite numbers, found 'a,2,1e999'",
    "hexadecimal": "line 3: expected a model and two finite numbers, found 'a,0x10,1'",
    "missing_altitude": "line 3: expected a model and two finite numbers, found 'a,,1'",
    "header_twice": "line 3: expected a model and two finite numbers, found "
    "'model,altitude,residual'",
    "duplicated_column": "line 1: expected the header model,altitude,residual, found "
    f"'model,altitude,altitude,residual'{ALSO}",
    "half_a_miss": "line 3: expected a model and 3 finite numbers, found 'a,2,,3'",
    "semicolons": "line 1: expected the header model,altitude,residual, found "
    f"'model;altitude;residual'{ALSO}; for other separators: sep=';', decimal=','",
    "decimal_commas": "line 3: expected a model and two finite numbers, found 'a,1,5,0,25'; for "
    "other separators: sep=';', decimal=','",
    "unit_in_cell": "line 3: expected a model and two finite numbers, found 'a,2 m,1'",
    "quoted_rubbish": """line 3: expected a model and two finite numbers, found '"a","2","one"'""",
    "open_quote": "cannot be read as a CSV file: unexpected end of data",
    "thousands_separator": "line 3: expected a model and two finite numbers, found "
    """'a,"1,000",2'""",
    "no_rows": "expected residuals below the header, found none",
    "empty": f"line 1: expected the header model,altitude,residual, found ''{ALSO}",
    "utf_16": "cannot be read as a CSV file: 'utf-8' codec can't decode byte 0xff in position 0: "
    "invalid start byte",
}


@pytest.mark.parametrize("path", sorted(FOLDER.glob("good/*.csv")), ids=lambda path: path.stem)
def test_a_file_says_the_same_however_it_was_written(path):
    residuals = read_residuals(path, ["small", "large"])
    np.testing.assert_array_equal(residuals.model, [0, 0, 1, 1])
    np.testing.assert_array_equal(residuals.altitude, [10, 5, 10, 2.5])
    np.testing.assert_array_equal(residuals.residual, [0.25, np.nan, -0.5, 0.001])
    np.testing.assert_array_equal(residuals.missed, [False, True, False, False])


@pytest.mark.parametrize("path", sorted(FOLDER.glob("bad/*.csv")), ids=lambda path: path.stem)
def test_a_bad_file_is_refused_in_a_line_that_says_where(path):
    with pytest.raises(ValueError) as caught:
        read_residuals(path)
    where = "," if BAD[path.stem].startswith("line") else ":"
    assert str(caught.value) == f"{path}{where} {BAD[path.stem]}"


def test_every_bad_file_is_known():
    assert {path.stem for path in FOLDER.glob("bad/*.csv")} == set(BAD)


@given(st.text("0123456789.eE+-_ naif٣２x", max_size=6))
def test_a_cell_is_a_number_if_python_reads_it_as_one_in_plain_ascii(tmp_path_factory, cell):
    path = tmp_path_factory.mktemp("cell") / "residuals.csv"
    path.write_text(f"model,altitude,residual\na,{cell},1\n", encoding="utf-8")
    try:
        number = float(cell)
        good = cell.isascii() and not set(cell) & set("_naif") and math.isfinite(number)
    except ValueError:
        good = False
    if good:
        assert read_residuals(path).altitude[0] == number
    else:
        with pytest.raises(ValueError, match="line 2: expected a model and two finite numbers"):
            read_residuals(path)


def test_semicolons_and_decimal_commas(tmp_path):
    path = tmp_path / "residuals.csv"
    path.write_text("model;altitude;residual\na;1,5;2,25\nb;3;\n")
    with pytest.raises(ValueError, match=r"sep=';', decimal=','$"):
        read_residuals(path)
    residuals = read_residuals(path, sep=";", decimal=",")
    np.testing.assert_array_equal(residuals.altitude, [1.5, 3])
    np.testing.assert_array_equal(residuals.residual, [2.25, np.nan])
    path.write_text("model;altitude;residual\na;1.500,5;2,25\n")  # a thousand, or one and a half?
    with pytest.raises(ValueError, match="line 2"):
        read_residuals(path, sep=";", decimal=",")
    for text, decimal in (("a;1,5;2", "."), ("a;1.5;2", ",")):  # a comma read as none, and a point
        path.write_text(f"model;altitude;residual\n{text}\n")
        with pytest.raises(ValueError, match=rf"found '{text}'; read with sep=';', .*'{decimal}'$"):
            read_residuals(path, sep=";", decimal=decimal)
    odd = ((",", ","), ("", "."), (";;", ","), (";", ";"), (None, "."), ("\n", "."), ('"', "."))
    for sep, decimal in odd:
        with pytest.raises(ValueError, match=r"^sep: expected ',' with decimal='\.'"):
            read_residuals(path, sep=sep, decimal=decimal)


def test_a_bad_line_is_found_by_halving(tmp_path, monkeypatch):
    path, looks, parsed = tmp_path / "residuals.csv", [], residual_files._parsed
    lines = ["model,altitude,residual", *(f"a,{i},1" for i in range(5000))]
    monkeypatch.setattr(residual_files, "_parsed", lambda *a: looks.append(1) or parsed(*a))
    for bad in (1, 2, 2500, 4999, 5000):
        path.write_text("\n".join([*lines[:bad], "a,1_0,1", *lines[bad + 1 :], "a,x,1"]))
        looks.clear()
        with pytest.raises(ValueError, match=f"line {bad + 1}: expected .* found 'a,1_0,1'$"):
            read_residuals(path)
        assert len(looks) < 16


@pytest.mark.no_cover
@pytest.mark.unmutated
def test_a_million_rows_are_checked_in_little_more_than_it_takes_to_split_them(tmp_path):
    path, numbers = tmp_path / "residuals.csv", np.random.default_rng(0).normal(size=(10**6, 2))
    rows = (f"m{i % 8},{x:.5f},{y:.5f}\n" for i, (x, y) in enumerate(numbers))
    path.write_text("model,altitude,residual\n" + "".join(rows))
    start = time.process_time()
    with path.open(newline="") as file:
        plain = [(w, float(x), float(y)) for w, x, y in list(csv.reader(file))[1:]]
    least, start = time.process_time() - start, time.process_time()
    residuals = read_residuals(path, resolution=1e-5)
    assert time.process_time() - start < 5 * least
    assert residuals.residual[-1] == plain[-1][2]
    np.testing.assert_allclose(residuals.residual, numbers[:, 1], atol=6e-6)


def test_many_columns_are_not_taken_for_other_separators(tmp_path):
    path = tmp_path / "residuals.csv"
    path.write_text("model,u,v,w,residual_x,residual_y\na,1,2,3,4,5\na,1,2,3,4,z\n")
    with pytest.raises(ValueError, match=r"5 finite numbers, found 'a,1,2,3,4,z'$"):
        read_residuals(path)


def test_thousands_of_columns(tmp_path):
    path, rng = tmp_path / "residuals.csv", np.random.default_rng(0)
    variables, components = [f"v{i}" for i in range(1500)], [f"residual_{i}" for i in range(500)]
    where, residual = rng.normal(size=(3, 1500)), rng.normal(size=(3, 500))
    write_residuals(path, Residuals(["a"], [0, 0, 0], where, residual, variables, components))
    back = read_residuals(path)
    np.testing.assert_array_equal(back.altitude, where)
    np.testing.assert_array_equal(back.residual, residual)


# ------------------------------------------------------------------------- whose price is it?


def test_prices_follow_names_and_not_the_first_line_of_a_file(tmp_path):
    path = tmp_path / "residuals.csv"
    lines = ["small,1,2.0", "small,1,3.0", "large,1,0.1", "large,1,0.2"]
    prices = {"small": 1.0, "large": 10.0}
    for kept in (lines, lines[::-1]):  # as if the first line of the small model had been lost
        path.write_text("\n".join(["model,altitude,residual", *kept]))
        residuals = read_residuals(path)
        suite = fit_suite(residuals, [1.0], prices, bins=[0, 2])
        assert dict(zip(suite.names, suite.cost, strict=True)) == prices
        with pytest.raises(ValueError, match=r"^cost: expected prices by name, {'.*': ..., '"):
            fit_suite(residuals, [1.0], [1, 10], bins=[0, 2])
        fit_suite(residuals, [1.0], [3, 3], bins=[0, 2])  # equal ones cannot be mistaken
        ordered = read_residuals(path, ["small", "large"])
        assert fit_suite(ordered, [1.0], [1, 10], bins=[0, 2]).cost.tolist() == [1, 10]


def test_every_suite_takes_prices_by_name():
    flat = lambda w, h: 0 * w + 0 * h + 1.0  # noqa: E731
    suite = gaussian_suite(flat, flat, {"small": 1, "large": [3, 4]}, at=[1.0, 2.0])
    assert suite.names == ("small", "large")
    np.testing.assert_array_equal(suite.cost, [[1, 3], [1, 4]])
    again = replace(suite, cost={"large": 7, "small": 2})
    np.testing.assert_array_equal(again.cost, [2, 7])
    named = SelectionProblem.from_suite(np.eye(2), suite, model_cost={"large": 7, "small": 2})
    np.testing.assert_array_equal(named.model_cost, [2, 7])
    with pytest.raises(ValueError, match=r"^cost: expected one for each of small, large, found"):
        SelectionProblem.from_suite(np.eye(2), suite, model_cost={"small": 1})
    for wrong in ({"small": 1}, {"small": 1, "large": 2, "huge": 3}, {}):
        with pytest.raises(
            ValueError, match=r"^cost: expected one for each of small, large, found"
        ):
            replace(suite, cost=wrong)
    with pytest.raises(ValueError, match=r"^cost\['large'\]: expected real numbers"):
        replace(suite, cost={"small": 1, "large": "dear"})
    with pytest.raises(ValueError, match=r"^cost: expected numbers, or all"):
        replace(suite, cost={"small": [1, 2], "large": [1, 2, 3]})


# --------------------------------------------------------------------- what data do not say


def one_model(residual, altitude=1.0, **given):
    return Residuals(
        ["a"], [0] * len(residual), np.full(len(residual), altitude), residual, **given
    )


def test_equal_residuals_tell_no_variance():
    for bins in ({"bins": [0, 2]}, {"kernel": Kernel()}):
        twice = Residuals(["a"], [0, 0, 0, 0], [1.0, 1.0, 9.0, 9.0], [0.1, 0.1, 0.1, 0.1])
        with pytest.raises(ValueError, match=r"^residuals: expected different ones of a near"):
            fit_suite(twice, [1.0], [1], **bins)
        rounded = replace(twice, resolution=0.1)
        suite = fit_suite(rounded, [1.0], [1], **({"bins": [0, 10]} if "bins" in bins else bins))
        np.testing.assert_allclose(suite.variance, 0.1**2 / 12)
        assert guard_suite(suite).mean[0, 0, 0] > 0.1
    nothing = np.zeros((1, 1, 1))
    with pytest.raises(ValueError, match=r"^suite: expected measured variances > 0, found 0"):
        guard_suite(PerceptionSuite(["a"], nothing, nothing, [1], [[5]], nothing))


def test_three_equal_decimals_are_equal_whatever_their_sum_rounds_to():
    with pytest.raises(ValueError, match=r"^residuals: expected different ones"):
        fit_suite(one_model([0.1] * 3), [1.0], [1], bins=[0, 2])


@given(SEEDS)
def test_a_resolution_is_the_variance_of_what_rounding_hides(seed):
    rng = np.random.default_rng(seed)
    q, spread = rng.uniform(0.5, 2), 1e-3
    exact = rng.normal(0, spread, 50)
    suite = fit_suite(one_model(q * np.round(exact / q), resolution=q), [1.0], [1], bins=[0, 2])
    assert suite.variance[0, 0, 0] == pytest.approx(q**2 / 12)
    fine = fit_suite(one_model(exact, resolution=1e-9), [1.0], [1], bins=[0, 2])
    assert fine.variance[0, 0, 0] == pytest.approx(exact.var(ddof=1))


def test_rows_that_were_logged_twice_are_counted(tmp_path):
    path, rng = tmp_path / "residuals.csv", np.random.default_rng(0)
    residuals = Residuals(["a"], [0] * 20, rng.uniform(0, 9, 20), rng.normal(size=20))
    write_residuals(path, residuals)
    read_residuals(path)  # no warning
    header, *lines = path.read_text().splitlines()
    path.write_text("\n".join([header, *lines, *lines[:7]]))
    with pytest.warns(UserWarning, match="7 of 27 rows repeat an earlier one to the last digit"):
        read_residuals(path)
    read_residuals(path, resolution=0.01)  # rounded errors may well be equal
    path.write_text("\n".join([header, *lines, "a,1.0,", "a,1.0,"]))
    read_residuals(path)  # and so may looks that gave nothing
    path.write_text("\n".join([header, "a,1,0.50", " a,1.0,5e-1", "b,1,.5", "a,0,0", "a,-0,0"]))
    with pytest.warns(UserWarning, match="2 of 5 rows repeat"):  # however they were written
        read_residuals(path)


def test_headings_err_by_degrees_and_not_by_turns(tmp_path):
    rng = np.random.default_rng(0)
    truth = rng.uniform(-180, 180, 4000)
    seen = (truth + rng.normal(0.5, 2, 4000) + 180) % 360 - 180
    table = {"bins": [0, 2]}
    with pytest.warns(UserWarning, match="errors lie around 0 and around 360: of angles, state"):
        plain = fit_suite(one_model(seen - truth), [1.0], [1], **table)
    with pytest.warns(UserWarning, match=r"errors lie around 0 and around 6\.283: of angles"):
        fit_suite(one_model(np.radians(seen - truth)), [1.0], [1], **table)
    outliers = np.append(rng.normal(size=50), [360, 355])  # two do not make an angle
    fit_suite(one_model(outliers), [1.0], [1], **table)
    suite = fit_suite(one_model(seen - truth, period=360), [1.0], [1], **table)
    assert math.sqrt(plain.variance[0, 0, 0]) > 20
    assert suite.mean[0, 0, 0] == pytest.approx(0.5, abs=0.15)
    assert math.sqrt(suite.variance[0, 0, 0]) == pytest.approx(2, abs=0.1)
    path = tmp_path / "residuals.csv"
    write_residuals(path, one_model(seen - truth))
    np.testing.assert_allclose(
        read_residuals(path, period=360).residual, one_model(seen - truth, period=360).residual
    )
    both = np.stack([seen - truth, seen - truth], axis=1)
    half = one_model(both, period=[360, np.inf])  # an angle beside a length
    np.testing.assert_array_equal(half.residual[:, 1], seen - truth)
    assert np.abs(half.residual[:, 0]).max() <= 180
    with pytest.warns(UserWarning, match="errors of a near step 0 reach half a period"):
        fit_suite(one_model(rng.uniform(-180, 180, 50), period=360), [1.0], [1], **table)


def looks(N, seed):
    """A model that gives nothing 70% of the time beyond 5, another that always sees."""
    rng = np.random.default_rng(seed)
    altitude, model = rng.uniform(0, 10, N), rng.integers(0, 2, N)
    residual = rng.normal(0.1 * (1 + model), 1, N)
    gone = (model == 0) & (altitude > 5) & (rng.random(N) < 0.7)
    return Residuals(["blind", "sure"], model, altitude, np.where(gone, np.nan, residual))


@pytest.mark.parametrize("how", [{"bins": [0, 5, 10]}, {"kernel": Kernel(0.2)}])
def test_looks_that_gave_nothing_are_counted_and_not_averaged(how, tmp_path):
    path = tmp_path / "residuals.csv"
    write_residuals(path, looks(6000, 0))
    residuals, way = read_residuals(path, ["blind", "sure"]), np.array([2.0, 8.0])
    suite = fit_suite(residuals, way, [1, 5], **how)
    np.testing.assert_allclose(suite.miss_rate, [[0, 0], [0.7, 0]], atol=0.06)
    np.testing.assert_allclose(suite.mean[..., 0], [[0.1, 0.2]] * 2, atol=0.15)
    with pytest.warns(UserWarning, match="looks that gave nothing are left out; see with_dropouts"):
        SelectionProblem.from_suite(np.eye(2), suite)
    whole = with_dropouts(suite, suite.miss_rate, "sure")
    np.testing.assert_allclose(whole.cost[1], [1 + 5 * suite.miss_rate[1, 0], 5])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SelectionProblem.from_suite(np.eye(2), whole)
    drawn = bootstrap_errors(residuals, way, 9, np.random.default_rng(0), **how)
    assert np.isfinite(drawn).all()
    assert suite.pick(["sure"]).miss_rate.tolist() == [[0], [0]]


def test_drawn_errors_have_the_moments_of_the_fit_where_some_looks_gave_nothing():
    """Far looks that gave nothing count for the spread of the altitude that a kernel goes by."""
    rng = np.random.default_rng(0)
    z = rng.uniform(0, 10, 4000)
    residual = np.where((z > 4) & (rng.random(4000) < 0.8), np.nan, z + rng.normal(size=4000))
    table, way = Residuals(["a"], np.zeros(4000, int), z, residual), [3.0, 7.0]
    suite = fit_suite(table, way, [1], kernel=Kernel(0.5))
    drawn = bootstrap_errors(table, way, 20000, rng, kernel=Kernel(0.5))[..., 0]
    np.testing.assert_allclose(drawn.mean(axis=0), suite.mean[..., 0], atol=0.06)
    np.testing.assert_allclose(drawn.var(axis=0), suite.variance[..., 0], rtol=0.04)
    blind = replace(table, residual=np.where(z > 4, np.nan, z))
    with pytest.raises(ValueError, match=r"^residuals: expected 2 or more of a near step 1, found"):
        bootstrap_errors(blind, [3.0, 9.0], 5, rng, kernel=Kernel(0.1))


def test_a_model_that_never_saw_anything_is_refused():
    with pytest.raises(
        ValueError, match=r"^residuals: expected some errors, found looks that gave"
    ):
        fit_suite(one_model([np.nan, np.nan]), [1.0], [1], bins=[0, 2])


def test_residuals_in_feet_along_a_way_in_metres_are_noticed():
    rng = np.random.default_rng(0)
    feet = rng.uniform(0, 330, 3000)
    residuals = Residuals(["a"], np.zeros(3000, int), feet, rng.normal(size=3000))
    way = np.linspace(0, 100, 20)
    for how in ({"bins": 10}, {"kernel": Kernel(0.05)}):
        with pytest.warns(UserWarning, match=r"\d+ of 3000 residuals count along") as caught:
            suite = fit_suite(residuals, way, [1], **how)
        assert "altitude from" in str(caught[0].message) and "one unit?" in str(caught[0].message)
        assert 0.3 < suite.used < 0.4
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert fit_suite(residuals, way / 0.3048, [1], **how).used > 0.99


# ------------------------------------------------------------------------------------ edges


def test_a_robot_that_hovers_is_told_what_to_state():
    residuals = Residuals(["a"], [0] * 4, [9.9, 10, 10, 10.1], [1.0, 2.0, 3.0, 4.0])
    with pytest.raises(
        ValueError, match=r"^trajectory: expected several altitudes to make 10 bins"
    ):
        fit_suite(residuals, [10.0, 10.0], [1])
    with pytest.raises(ValueError, match=r"^trajectory: expected several altitudes to make 3 bins"):
        altitude_bins(residuals.altitude, [10.0, 10.0], 3)
    suite = fit_suite(residuals, [10.0, 10.0], [1], bins=[9.5, 10.5])
    np.testing.assert_array_equal(suite.mean[:, 0, 0], [2.5, 2.5])


def test_edges_are_where_their_digits_say():
    edges = np.array([0, 0.1 + 0.2, 0.6])  # 0.30000000000000004
    residuals = Residuals(["a"], [0] * 4, [0.1, 0.1, 0.3, 0.3], [1.0, 2.0, 3.0, 5.0])
    suite = fit_suite(residuals, [0.3], [1], bins=edges)
    assert suite.mean[0, 0, 0] == 4 and suite.sample_size[0, 0] == 2
    tenths = np.arange(-1, 1.1, 0.1)  # ends with 1.0000000000000018
    way = Residuals(["a"], [0] * 42, np.repeat(np.linspace(-1, 1, 21), 2), np.arange(42.0))
    assert fit_suite(way, np.linspace(-1, 1, 5), [1], bins=tenths).sample_size.max() == 4
    short = Residuals(["a"], [0, 0], [0.95, 0.95], [1.0, 2.0])
    with pytest.raises(ValueError, match=r"to 0\.95000001 or more, found 2 edges from 0 to 0\.95$"):
        fit_suite(short, [0.95000001], [1], bins=[0, 0.95])


# ----------------------------------------------------------------------------------- tables


class Frame:
    """What is asked of a table: column names, and columns by name."""

    def __init__(self, **columns):
        self.columns, self._columns = list(columns), columns

    def __getitem__(self, name):
        return self._columns[name]


def test_a_table_with_the_right_columns_is_taken():
    rng = np.random.default_rng(0)
    columns = {
        "model": ["b", "a"] * 10,
        "range": rng.uniform(0, 1, 20),
        "residual": rng.normal(size=20),
    }
    prices, way = {"a": 1, "b": 2}, [0.2, 0.7]
    suite = fit_suite(Frame(**columns), way, prices, bins=[0, 1])
    assert suite.names == ("b", "a")
    index = [0, 1] * 10
    plain = Residuals(["b", "a"], index, columns["range"], columns["residual"], ["range"])
    np.testing.assert_array_equal(suite.mean, fit_suite(plain, way, prices, bins=[0, 1]).mean)
    with pytest.raises(ValueError, match=r"^cost: expected prices by name"):
        fit_suite(Frame(**columns), way, [2, 1], bins=[0, 1])
    drawn = bootstrap_errors(Frame(**columns), way, 3, np.random.default_rng(0), bins=[0, 1])
    assert drawn.shape == (3, 2, 2, 1)
    wrong = (Frame(model=[], height=[]), {"model": []}, columns["residual"], None, "residuals.csv")
    for other in wrong:
        with pytest.raises(
            ValueError, match=r"^residuals: expected Residuals, or a table with the"
        ):
            fit_suite(other, way, prices)


def test_a_table_is_looked_at_as_closely_as_a_file():
    good = {"model": ["a"] * 4, "x": [1.0, 2, 3, 4], "residual": [1.0, 2, 4, 7]}
    for changes, message in (
        ({"model": ["a", "a", "a", np.nan]}, "residuals: expected a model in every row, found nan"),
        ({"model": ["a", None, "a", "a"]}, "residuals: expected a model in every row, found None"),
        (
            {"x": np.arange(4).astype("datetime64[s]")},
            "x: expected real numbers, found dtype datet",
        ),
        ({"x": [1.0, 2, 3]}, r"x: expected shape \(N,\) = \(4,\), found \(3,\)"),
        ({"x": ["1_0", "2", "3", "4"]}, "x: expected real numbers, found dtype <U3"),
    ):
        with pytest.raises(ValueError, match=f"^{message}"):
            fit_suite(Frame(**good | changes), [2.0], {"a": 1}, bins=[0, 9])
    twice = Frame(model=["a"] * 8, x=good["x"] * 2, residual=good["residual"] * 2)
    with pytest.warns(UserWarning, match="^residuals: 4 of 8 rows repeat an earlier one"):
        fit_suite(twice, [2.0], {"a": 1}, bins=[0, 9])
    numbered = Frame(**good)
    numbered.columns, numbered._columns[0] = ["model", 0, "residual"], numbered._columns.pop("x")
    assert fit_suite(numbered, [2.0], {"a": 1}, bins=[0, 9]).mean[0, 0, 0] == 3.5


def test_pandas_frames_are_such_tables():
    pandas = pytest.importorskip("pandas", reason="pandas is no dependency of ours")
    frame = pandas.DataFrame(
        {"model": ["a"] * 4, "x": [1, 2, 3, 4.0], "residual": [1, 2, 4, np.nan]}
    )
    suite = fit_suite(frame, {"x": [2.0]}, {"a": 1}, bins=[0, 9])
    assert suite.mean[0, 0, 0] == pytest.approx(7 / 3) and suite.miss_rate[0, 0] == 0.25


def test_a_guard_takes_covariances():
    rng = np.random.default_rng(0)
    residuals = one_model(rng.normal(size=(30, 2)) @ [[1, -0.5], [0, 1]])
    suite = fit_suite(residuals, [1.0, 1.0], [1], bins=[0, 2])
    guarded = guard_suite(suite)
    assert suite.variance.shape == guarded.variance.shape == (2, 1, 2, 2)
    assert suite.variance.min() < 0  # between components that err in opposite directions
    assert (np.abs(guarded.mean) > np.abs(suite.mean)).all()
    larger = guarded.variance / suite.variance
    np.testing.assert_allclose(larger, larger[0, 0, 0, 0])
    assert larger.min() > 1


def test_three_lines_for_a_model_that_sometimes_sees_nothing():
    suite = fit_suite(looks(900, 1), [2.0, 8.0], {"blind": 1, "sure": 5}, bins=[0, 5, 10])
    problem = SelectionProblem.from_suite(np.eye(2), with_dropouts(suite, suite.miss_rate, "sure"))
    assert problem.model_cost[1, 0] > problem.model_cost[0, 0]


def test_parts_of_the_house_are_where_they_were():
    assert perception.read_residuals is read_residuals and perception.Residuals is Residuals


def test_a_model_that_sees_nothing_far_away_is_not_available_there():
    rng = np.random.default_rng(0)
    z, model = rng.uniform(0, 10, 4000), rng.integers(0, 2, 4000)
    residual = np.where((model == 0) & (z > 5), np.nan, rng.normal(size=4000))
    table = Residuals(["near", "far"], model, z, residual)
    suite = fit_suite(table, [2.0, 9.0], [1, 3], kernel=Kernel(0.1))
    np.testing.assert_array_equal(suite.cost, [[1, 3], [np.inf, 3]])
    np.testing.assert_array_equal(suite.miss_rate, [[0, 0], [1, 0]])
    whole = with_dropouts(suite, suite.miss_rate, ([0.0], [4.0]))
    assert whole.variance[1, 0, 0] == 4 and whole.cost[1, 0] == np.inf
    with pytest.raises(ValueError, match=r"^residuals: expected 2 or more of near at altitudes"):
        fit_suite(table, [2.0, 9.0], [1, 3], bins=[0, 8, 10])
