"""Records: rows of results, folders of one configuration each, plan files, and provenance."""

from jaxsimp.records.files import set_aside, whole_file, write_json, write_text
from jaxsimp.records.folder import CONFIG_FILE, open_folder
from jaxsimp.records.lock import ResultsError, lock_folder
from jaxsimp.records.plan_file import SavedPlan, load_plan, save_plan
from jaxsimp.records.provenance import environment
from jaxsimp.records.rows import RowFile, append_row, environments, read_rows

__all__ = [
    "CONFIG_FILE",
    "ResultsError",
    "RowFile",
    "SavedPlan",
    "append_row",
    "environment",
    "environments",
    "load_plan",
    "lock_folder",
    "open_folder",
    "read_rows",
    "save_plan",
    "set_aside",
    "whole_file",
    "write_json",
    "write_text",
]
