"""Records: folders of results, rows, and JSON, with files that were damaged."""

import contextlib
import json
import shutil
from pathlib import Path
from random import Random
from typing import Any

from hypothesis import strategies as st

from jaxsimp import records
from tests.fuzz.core import Door, Parameter
from tests.fuzz.files import FOLDER, MUTATIONS

CONFIG = {"name": "fuzz", "seeds": 3, "tasks": ["a", "b"]}
ROWS = [{"task": "a", "seed": seed, "score": 0.5 * seed} for seed in range(3)]
TEXT = "".join(json.dumps(row) + "\n" for row in ROWS).encode()
CONFIG_TEXT = (json.dumps(CONFIG, indent=1) + "\n").encode()


def _damaged(content: bytes, kind: str, seed: int) -> bytes:
    return MUTATIONS[kind](content, Random(seed)) if kind else content


def _damages(content: bytes) -> Parameter:
    kinds = st.sampled_from(list(MUTATIONS))
    wrong = st.builds(_damaged, st.just(content), kinds, st.integers(0, 10**6))
    odd = st.sampled_from(
        (
            b"\n\n",
            b"{}\n",
            b"[]\n",
            b"null\n",
            b"1\n",
            b'"text"\n',
            b"{\n",
            b"\x00" * 64,
            b'{"task": "a"}\n',
            content + b"garbage\n",
            content + b"\n" + content,
            content[:-1],
            content + b'{"task": [1], "seed": {}, "score": NaN}\n',
            content.replace(b"\n", b"\r\n"),
            b"[" * 100_000 + b"\n",
        )
    )
    return Parameter(st.just(content), wrong | odd, optional=False)


def _fresh() -> Path:
    folder = FOLDER / "results"
    if folder.is_dir():
        shutil.rmtree(folder)
    else:
        folder.unlink(missing_ok=True)
    folder.mkdir(parents=True)
    return folder


def _rows_of(content: bytes) -> list[dict[str, Any]]:
    """Rows of a file with such content, and which rows are left of three."""
    path = _fresh() / "runs.jsonl"
    path.write_bytes(content)
    rows = records.read_rows(path)
    file = records.RowFile(path, ("task", "seed"))
    left = file.left([("a", seed) for seed in range(3)])
    done = [("a", seed) for seed in range(3) if ("a", seed) not in left]
    assert file.in_order(done) is not None
    for _, seed in left:
        file.append(ROWS[seed])
    assert len(file.in_order([("a", seed) for seed in range(3)])) == 3, "a row is missing"
    return rows


def _are_whole(content: bytes) -> bool | None:
    return True if content == TEXT else None


def _check_rows(rows: Any, content: bytes) -> None:
    assert all(isinstance(row, dict) for row in rows), "a row is no mapping"
    if content == TEXT:
        assert rows == ROWS, "other rows"
    whole = [line for line in content.split(b"\n")[:-1] if line.strip()]
    assert len(rows) <= len(whole), "more rows than whole lines"


def _lines_are_objects(content: bytes) -> bool:
    """Whether each whole line of a file is a JSON object with the fields of a row."""
    for line in content.split(b"\n")[:-1]:
        try:
            row = json.loads(line.decode())
        except (ValueError, RecursionError):
            return False
        if not (isinstance(row, dict) and {"task", "seed"} <= row.keys()):
            return False
    return True


def _is_row_file(content: bytes) -> bool | None:
    if content == TEXT:
        return True
    return None if _lines_are_objects(content) else _bad_lines(content)


def _bad_lines(content: bytes) -> bool | None:
    """Blank lines may be passed over; others are refused, not lost."""
    lines = content.split(b"\n")[:-1]
    is_bad = any(line.strip() and not _lines_are_objects(line + b"\n") for line in lines)
    return False if is_bad else None


def held(folder: Path, config: Any) -> contextlib.AbstractContextManager[Any]:
    """A folder of results that is open: as a context, or else for good."""
    opened = records.open_folder(folder, config)
    return opened if hasattr(opened, "__enter__") else contextlib.nullcontext()


def _open_with(content: bytes | None, others: tuple[str, ...] = ()) -> Path:
    folder = _fresh()
    if content is not None:
        (folder / records.CONFIG_FILE).write_bytes(content)
    for name in others:
        (folder / name).write_text("{")
    with held(folder, CONFIG):
        assert json.loads((folder / records.CONFIG_FILE).read_text()) == CONFIG
    return folder


def _is_config(content: bytes | None, others: tuple[str, ...] = ()) -> bool | None:
    if content is None:
        return set(others) <= {"config.json.part", "lock"}
    try:
        same = json.loads(content.decode()) == CONFIG
    except (ValueError, RecursionError):
        return False
    return True if content == CONFIG_TEXT else (None if same else False)


def _check_config(folder: Path, **_: Any) -> None:
    found = json.loads((folder / records.CONFIG_FILE).read_text())
    assert found == CONFIG, "another configuration is written"


DOORS = (
    Door(
        "records.read_rows",
        _rows_of,
        {"content": _damages(TEXT)},
        _is_row_file,
        _check_rows,
        weight=40,
    ),
    Door(
        "records.open_folder",
        _open_with,
        {
            "content": Parameter(
                st.just(CONFIG_TEXT) | st.just(None), _damages(CONFIG_TEXT).hostile, False
            ),
            "others": Parameter(
                st.just(()), st.sampled_from((("config.json.part",), ("notes.txt",), (".DS",)))
            ),
        },
        _is_config,
        _check_config,
        weight=25,
    ),
)
