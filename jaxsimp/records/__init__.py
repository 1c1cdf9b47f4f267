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

__all__ = [
    "CONFIG_FILE",
    "ResultsError",
    "append_row",
    "environment",
    "open_folder",
    "read_rows",
    "write_json",
]
