"""A year of recordings, a fleet of cameras, one question: when did which camera move, and how far?

    python parquet_of_a_year.py recordings/ fleet/

``recordings/`` holds what monitors have recorded (.rrd), in any number of folders.  ``fleet/`` gets them as Parquet, by
robot, camera and day; running it again replaces what has grown and doubles nothing.  pyarrow then reads only the
columns and days that a question names, so a year costs no more memory than its answer.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds

from gripmon.record.export import export

MOVEMENTS = ["step", "creep", "drift"]
ALERT = ["robot", "camera", "recording_id", "alert_id"]


def movements(fleet: Path) -> pa.Table:
    """A row for each movement that a monitor noticed: ``noticed`` (UTC), and ``shift_m`` of the TCP at its largest."""
    alerts = ds.dataset(fleet / "alerts", partitioning="hive").to_table(
        columns=[*ALERT, "time", "tcp_shift_x_m", "tcp_shift_y_m", "tcp_shift_z_m"],
        filter=ds.field("kind").isin(MOVEMENTS) & ds.field("event").isin(["raised", "updated"]),
    )
    squares = [pc.power(alerts[f"tcp_shift_{axis}_m"], 2.0) for axis in "xyz"]
    size_m = pc.sqrt(pc.add(pc.add(squares[0], squares[1]), squares[2]))
    table = alerts.append_column("shift_m", size_m).group_by(ALERT).aggregate([("time", "min"), ("shift_m", "max")])
    table = table.rename_columns({"time_min": "noticed", "shift_m_max": "shift_m"})
    return table.sort_by([("noticed", "ascending")]).select(["robot", "camera", "noticed", "shift_m"])


def days(fleet: Path) -> pa.Table:
    """A row for each camera and day: frames, and the part of them with a transform that was ``valid``."""
    frames = ds.dataset(fleet / "frames", partitioning="hive").to_table(columns=["robot", "camera", "date", "verdict"])
    valid = pc.cast(pc.equal(frames["verdict"], "valid"), pa.float64())
    counted = frames.append_column("valid", valid).group_by(["robot", "camera", "date"])
    table = counted.aggregate([("valid", "count"), ("valid", "mean")])
    table = table.rename_columns({"valid_count": "frames", "valid_mean": "valid_share"})
    return table.sort_by([("robot", "ascending"), ("camera", "ascending"), ("date", "ascending")])


def main(recordings: Path, fleet: Path) -> None:
    """Export, then ask."""
    for fault in export([recordings], fleet).faults:
        print(fault, file=sys.stderr)
    print("when did which camera move?")
    moved = movements(fleet)
    to_us = moved["noticed"].cast(pa.timestamp("us", "UTC"), safe=False)  # Python's datetime has no nanoseconds
    for row in moved.set_column(moved.column_names.index("noticed"), "noticed", to_us).to_pylist():
        print(f"  {row['noticed']:%Y-%m-%d %H:%M:%S}  {row['robot']}/{row['camera']}  {1e3 * row['shift_m']:.2f} mm")
    print("how was each day?")
    for row in days(fleet).to_pylist():
        share = 100.0 * row["valid_share"]
        print(f"  {row['date']}  {row['robot']}/{row['camera']}  {row['frames']} frames, {share:.0f} % valid")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
