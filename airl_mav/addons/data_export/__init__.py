"""Export of a run's data: CSV and Parquet tables, Minari and LeRobot data sets.

Command: `airl export-data`. From Python: `Run.table`.
Depends on: the extra `data` (pandas, pyarrow, minari) for all formats except CSV.
Guide: docs/how-to/export-data.md.
"""

COMMANDS = {
    "export-data": (
        "logs",
        "write tables or data sets: CSV, Parquet, Minari, LeRobot",
        "airl_mav.addons.data_export.export_data",
    )
}
