"""The door for numbers."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from jaxsimp.checks import require_choice, require_count, require_number, require_numbers


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
