"""Rows of results: they survive a kill, and say what is left to do."""

import pytest

from jaxsimp.records import RowFile, append_row, read_rows

ROWS = [{"seed": 0, "name": "ü\u2028 \n"}, {"seed": 1, "cost": None}, {"seed": 2}]


def test_rows_come_back_in_order(tmp_path):
    path = tmp_path / "runs.jsonl"
    assert read_rows(path) == []
    for row in ROWS:
        append_row(path, row)
    assert read_rows(path) == ROWS
    assert len(path.read_text().split("\n")) == len(ROWS) + 1


def test_a_row_cut_short_at_any_byte_is_dropped_and_the_file_can_be_continued(tmp_path):
    path = tmp_path / "runs.jsonl"
    for row in ROWS:
        append_row(path, row)
    whole = path.read_bytes()
    ends = [0, *(i + 1 for i, byte in enumerate(whole) if byte == ord("\n"))]
    for size in range(len(whole) + 1):
        path.write_bytes(whole[:size])
        complete = sum(end <= size for end in ends) - 1
        assert read_rows(path) == ROWS[:complete]
        assert path.stat().st_size == ends[complete]
        append_row(path, {"more": 1})
        assert read_rows(path) == [*ROWS[:complete], {"more": 1}]


# --- resuming ------------------------------------------------------------------------------------

KEYS = [("a", 0), ("a", 1), ("b", 0)]


@pytest.fixture
def rows(tmp_path):
    return RowFile(tmp_path / "runs.jsonl", ("task", "seed"))


def test_all_is_left_before_the_first_row(rows):
    assert rows.left(KEYS) == KEYS
    assert rows.in_order([]) == []


def test_what_has_a_row_is_not_left(rows):
    rows.append({"score": 0.5, "seed": 1, "task": "a"})
    assert rows.left(KEYS) == [KEYS[0], KEYS[2]]
    assert rows.left(reversed(KEYS)) == [KEYS[2], KEYS[0]]


def test_rows_come_in_the_order_of_the_keys(rows):
    for task, seed in KEYS:
        rows.append({"task": task, "seed": seed})
    order = [KEYS[2], KEYS[0]]
    assert [rows.key(row) for row in rows.in_order(order)] == order


def test_a_row_cut_short_is_left_to_do(rows):
    rows.append({"task": "a", "seed": 0})
    rows.append({"task": "a", "seed": 1})
    rows.path.write_text(rows.path.read_text()[:-3])
    assert rows.left(KEYS) == KEYS[1:]
    with pytest.raises(KeyError):
        rows.in_order(KEYS[:2])
