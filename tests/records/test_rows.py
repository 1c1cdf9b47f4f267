"""Rows of results: they survive a kill, and say what is left to do."""

import json

import pytest

from jaxsimp.records import ResultsError, RowFile, append_row, environments, read_rows

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
        assert path.stat().st_size == size  # who reads does not change the file: another may write
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


def test_of_several_rows_of_a_key_the_last_counts(rows):
    for score in (0.1, 0.2):
        for task, seed in KEYS[:2]:
            rows.append({"task": task, "seed": seed, "score": score})
    assert rows.left(KEYS) == KEYS[2:]
    assert [row["score"] for row in rows.rows()] == [0.2, 0.2]
    assert [row["score"] for row in rows.in_order(KEYS[:2])] == [0.2, 0.2]


# --- damage --------------------------------------------------------------------------------------

HERE = {"versions": {"jax": "0.9", "numpy": "2.1"}, "x64": False, "platform": "kernel 1"}
GARBAGE = {
    "garbage": (b"!! not a row", "it is no JSON: b'!! not a row'"),
    "blank": (b"", "it is blank"),
    "binary": (b"\xff\xfe\x00\x01", "it is no JSON: b'\\xff\\xfe\\x00\\x01'"),
    "half a row": (b'{"task": "a", "se', "it is no JSON"),
    "foreign": (b'{"name": "x"}', "it has no field 'task'"),
    "no fields": (b"[1, 2]", "it has no fields: b'[1, 2]'"),
    "odd key": (b'{"task": ["a"], "seed": 0}', "its field 'task' is no single value"),
    "deep": (b"[" * 100_000, "it is no JSON"),
}


@pytest.fixture
def three(rows):
    for task, seed in KEYS:
        rows.append({"task": task, "seed": seed, "environment": HERE})
    return rows


@pytest.mark.parametrize("kind", GARBAGE)
def test_a_damaged_line_is_told_set_aside_and_left_to_do(three, kind):
    line, fault = GARBAGE[kind]
    lines = three.path.read_bytes().splitlines(keepends=True)
    damaged = lines[0] + line + b"\n" + lines[2]
    three.path.write_bytes(damaged)
    with pytest.raises(ResultsError, match=r"runs\.jsonl, line 2 .*; run the study .* again"):
        three.left(KEYS)
    assert three.path.read_bytes() == damaged
    told = []
    three.resume(HERE, tell=told.append)
    (line,) = told
    assert line.startswith(f"{three.path}, line 2 is no row of results, {fault}")
    assert line.endswith("kept as runs.jsonl.damaged-1, and what is missing is made again")
    assert three.path.read_bytes() == lines[0] + lines[2]
    assert three.path.with_name("runs.jsonl.damaged-1").read_bytes() == damaged
    assert three.left(KEYS) == KEYS[1:2]
    three.resume(HERE, tell=told.append)
    assert len(told) == 1


def test_all_damaged_lines_are_counted(three):
    three.path.write_bytes(b"\n\n" + three.path.read_bytes() + b"\x00\x00\x00")
    told = []
    three.resume(HERE, tell=told.append)
    assert "line 1 is no row of results, it is blank (and 2 more such lines);" in told[0]
    assert three.left(KEYS) == []


def test_a_row_without_a_field_that_is_needed_is_damaged(rows):
    rows.append({"task": "a", "seed": 0})
    needing = RowFile(rows.path, rows.identity, ("score",))
    with pytest.raises(ResultsError, match=r"line 1 .* no field 'score'"):
        needing.rows()


def test_a_row_that_a_kill_cut_is_no_damage(three):
    whole = three.path.read_bytes()
    three.path.write_bytes(whole[:-5])
    told = []
    three.resume(HERE, tell=told.append)
    assert told == []
    assert three.path.read_bytes() == b"".join(whole.splitlines(keepends=True)[:2])


def test_a_row_with_a_fault_is_told_and_left_to_do(three):
    told = []
    fault = {("a", 1): "its plan is missing"}.get
    three.resume(HERE, fault=lambda row: fault(three.key(row)), tell=told.append)
    assert told == ["its plan is missing; it is made again"]
    assert three.left(KEYS) == [("a", 1)]


# --- environments --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"x64": True}, r"x64 differ \(x64: False there, True now\)"),
        ({"versions": {"jax": "1.0", "numpy": "2.1"}}, r"versions\.jax: '0\.9' there, '1\.0' now"),
        ({"settings": {"jax_default_prng_impl": "rbg"}}, r"prng_impl: None there, 'rbg' now"),
    ],
)
def test_rows_of_another_environment_are_refused_unless_mixed(three, change, told):
    before = three.path.read_bytes() + b"garbage\n"
    three.path.write_bytes(before)
    with pytest.raises(ResultsError, match=rf"{told}.*--out, or --mixed to go on"):
        three.resume(HERE | change)
    assert three.path.read_bytes() == before  # nothing is changed
    three.resume(HERE | change, mixed=True, tell=lambda line: None)
    assert three.left(KEYS) == []


def test_another_kernel_is_the_same_environment(three):
    three.resume(HERE | {"platform": "kernel 2"})


def test_rows_that_do_not_tell_their_environment_are_of_another(rows):
    rows.append({"task": "a", "seed": 0})
    with pytest.raises(ResultsError, match=r"'0\.9' now"):
        rows.resume(HERE)


def test_rows_are_counted_by_environment(three):
    other = json.loads(json.dumps(HERE)) | {"x64": True}
    moved = HERE | {"platform": "kernel 2"}
    found = [{"environment": each} for each in (HERE, other, moved, other)] + [{}]
    assert environments(found) == [(HERE, 2), (other, 2), (None, 1)]
