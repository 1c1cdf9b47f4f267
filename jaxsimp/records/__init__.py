"""Records: rows of results, folders of one configuration each, plan files, and provenance."""

from jaxsimp.records.folder import CONFIG_FILE, ResultsError, open_folder, write_json
from jaxsimp.records.plan_file import SavedPlan, load_plan, save_plan
from jaxsimp.records.provenance import environment
from jaxsimp.records.rows import RowFile, append_row, read_rows

__all__ = [
    "CONFIG_FILE",
    "ResultsError",
    "RowFile",
    "SavedPlan",
    "append_row",
    "environment",
    "load_plan",
    "open_folder",
    "read_rows",
    "save_plan",
    "write_json",
]
