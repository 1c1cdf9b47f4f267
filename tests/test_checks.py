"""The door for numbers."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from jaxsimp.checks import (
    require_choice,
    require_count,
    require_ids,
    require_number,
    require_numbers,
    require_reals,
    require_rows,
    require_shape,
    require_whole,
)


@pytest.mark.parametrize("value", [3, np.int32(3), np.uint8(3)])
def test_whole_numbers_of_any_type_are_counts(value):
    found = require_count("num", value, 1)
    assert found == 3
    assert type(found) is int


@pytest.mark.parametrize("value", [0, -1, 2.0, 2.5, True, "2", None, math.nan, 1j, 2**40, [2]])
def test_other_values_are_no_counts(value):
    with pytest.raises(ValueError, match=r"num is .*; give a whole number of at least 1"):
        require_count("num", value, 1)


def test_a_count_may_have_an_upper_limit():
    with pytest.raises(ValueError, match="num is 9; give a whole number from 1 to 8"):
        require_count("num", 9, 1, 8)


@given(st.floats() | st.integers() | st.booleans() | st.complex_numbers() | st.text())
def test_a_number_is_returned_or_refused_with_its_limits(value):
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    if is_real and 0.5 <= value <= 2:
        assert require_number("mass", value, 0.5, 2.0, "kg") == value
    else:
        with pytest.raises(ValueError, match=r"mass is .*; give a number from 0.5 to 2 kg"):
            require_number("mass", value, 0.5, 2.0, "kg")


def test_the_first_number_of_an_array_that_is_out_of_its_limits_is_named():
    values = np.array([[1.0, 2.0], [math.nan, 9.0]])
    with pytest.raises(ValueError, match=r"mass\[1, 0\] is nan; give numbers from 0 to 5 kg"):
        require_numbers("mass", values, 0.0, 5.0, "kg")


@pytest.mark.parametrize("values", [[1j], [True], ["a"], None, [[1.0], [1.0, 2.0]], [10**400]])
def test_arrays_of_other_things_are_refused(values):
    with pytest.raises(ValueError, match=r"mass is .*; give an array of numbers"):
        require_numbers("mass", values, 0.0, 5.0)


def test_a_choice_is_one_of_the_known_names():
    require_choice("method", "paper", ("robust", "paper"))
    for value in ("papr", None, ["paper"]):
        with pytest.raises(ValueError, match=r"method is .*; choose from robust, paper"):
            require_choice("method", value, ("robust", "paper"))


@pytest.mark.parametrize("values", [[0, 2], np.array([2, 0], np.uint8), np.zeros((2, 0), int)])
def test_ids_of_any_whole_type_and_shape_are_int64(values):
    found = require_ids("faces", values, 3)
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, values)


@pytest.mark.parametrize(
    ("values", "count", "message"),
    [
        ([0, 3], 3, "faces names 3; the ids of 3 points are 0 to 2: give one of"),
        ([-1], 3, "faces names -1; the ids of 3 points"),
        ([2**40], 3, "faces names 1099511627776"),
        ([0], 0, "faces names 0, and there are no points; give at least one first"),
        ([0.0], 3, r"faces is \[0.0\]; give an array of whole numbers"),
        ([True], 3, r"faces is \[True\]; give an array of whole"),
        ([[0], [1, 2]], 3, "faces is .*; give an array of whole"),
        (None, 3, "faces is None; give an array of whole"),
    ],
)
def test_what_names_nothing_is_refused(values, count, message):
    with pytest.raises(ValueError, match=message):
        require_ids("faces", values, count, "points")


@pytest.mark.parametrize("values", [[0.5], "ab", None, 1j, [[1], [1, 2]]])
def test_what_is_no_array_of_whole_numbers_is_refused(values):
    with pytest.raises(ValueError, match=r"ids is .*; give an array of whole numbers"):
        require_whole("ids", values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([1.0, 2.0], r"points is an array of shape \(2,\); give rows of 3 real numbers, in m"),
        ([[1.0, 2.0]], r"points is an array of shape \(1, 2\); give rows of 3"),
        ([[1j, 0, 0]], r"points is \[\[1j, 0, 0\]\]; give rows of 3 real numbers"),
        (
            [[0, 0, 0], [0, math.inf, 0]],
            r"points\[1\] is \[0.0, inf, 0.0\] \(1 such rows\); give fin",
        ),
    ],
)
def test_rows_are_finite_numbers_of_one_width(values, message):
    np.testing.assert_array_equal(require_rows("points", [[1, 2, 3]], 3), [[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match=message):
        require_rows("points", values, 3)


def test_an_array_of_another_shape_is_refused_with_the_shape_to_give():
    why = "one row for each particle"
    require_shape("rest", np.zeros((5, 3)), ("N", 3), why)
    require_shape("mass", np.zeros(5), (5,), why)
    for wanted, message in (
        ((5, 2), r"rest has shape \(5, 3\); give shape \(5, 2\), one row for each particle"),
        (("N", 2), r"give shape \(N, 2\)"),
        ((5,), r"give shape \(5,\)"),
        ((), r"give shape \(\)"),
        (("B", 5, 3), r"give shape \(B, 5, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            require_shape("rest", np.zeros((5, 3)), wanted, why)


def test_real_numbers_of_a_shape_are_floats_finite_or_not():
    found = require_reals("goal", [[1, 2, math.nan]], ("N", 3), "a row of x, y, z")
    np.testing.assert_array_equal(found, [[1.0, 2.0, math.nan]])
    assert found.dtype == float
    for values, message in (
        ([[1], [1, 2]], r"goal is \[\[1\], \[1, 2\]\]; give real numbers, a row of x, y, z"),
        ([[True] * 3], r"goal is \[\[True, True, True\]\]; give real"),
        ([1, 2, 3], r"goal has shape \(3,\); give shape \(N, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            require_reals("goal", values, ("N", 3), "a row of x, y, z")


def test_a_masked_value_is_not_known():
    masked = np.ma.masked_array([[1.0, 2.0]], [[False, True]])
    with pytest.raises(ValueError, match=r"mass\[0, 1\] is nan; give numbers from 0 to 9 kg"):
        require_numbers("mass", masked, 0.0, 9.0, "kg")
    with pytest.raises(ValueError, match=r"faces is .*; give an array of whole numbers"):
        require_whole("faces", np.ma.masked_array([1, 2], [False, True]))
    whole = np.ma.masked_array([[1.0, 2.0]])
    assert type(require_numbers("mass", whole, 0.0, 9.0)) is np.ndarray
