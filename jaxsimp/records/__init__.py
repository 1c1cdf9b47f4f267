"""Records: rows of results, folders that one configuration owns, and provenance."""

from jaxsimp.records.folder import (
    CONFIG_FILE,
    ResultsError,
    append_row,
    environment,
    open_folder,
    read_rows,
    write_json,
)
from jaxsimp.records.plan_file import load_plan, save_plan

__all__ = [
    "CONFIG_FILE",
    "ResultsError",
    "append_row",
    "environment",
    "load_plan",
    "open_folder",
    "read_rows",
    "save_plan",
    "write_json",
]
