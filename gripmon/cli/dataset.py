"""``gripmon dataset``: the extrinsics of every episode and wrist camera of a dataset."""

from __future__ import annotations

import argparse

from gripmon.cli.common import REQUIRED, Arguments, Command, note, positive_number, progress_bar, whole_number
from gripmon.model.errors import InputError
from gripmon.model.stopping import EXIT_DONE, EXIT_FAILED

_OPTIONS = """
DATASET          folder or URL; all episodes below it are measured
--config CONFIG  configuration (YAML) with gripper, camera and a rough reference; its source section gives the opening
--out DIR        folder for the results; created if missing
--camera NAME...  a topic of .mcap and rosbag2, a feature of LeRobot; may be repeated (default: the only one)
--own-lens       use the configuration's camera calibration even if a file contains one
--engine NAME    local (processes on this machine, the default) or ray (a Ray cluster)
--workers N      processes of --engine local (default: the number of cores)
--address HOST   address of the Ray cluster, as for ray.init (default: the one that Ray finds, or this machine)
--level P        probability that any stretch is separated from its mounting by chance (default 0.01)
--tolerance-mm MM    transforms within this and --tolerance-deg share a mounting, whatever their covariances (mm)
--tolerance-deg DEG  the same for the rotation (degrees)
"""

_EXAMPLES = """\
  gripmon dataset set/ --config wrist.yaml --out extrinsics --camera observation.images.wrist
  gripmon dataset s3://lab/episodes --config wrist.yaml --out extrinsics --camera /wrist/image_raw/compressed
  gripmon dataset set/ --config wrist.yaml --out extrinsics --engine ray --address auto

exit codes: 0 done, failures are rows with a reason; 2 wrong usage or configuration; 3 no episode gave a
transform; 130 interrupted (call again to continue)"""


def _probability(text: str) -> float:
    value = positive_number(text)
    if value >= 1.0:
        raise argparse.ArgumentTypeError(f"{text} isn't a small probability; below 1")
    return value


@Command(
    _OPTIONS, _EXAMPLES,
    config=REQUIRED, out=REQUIRED, engine={"choices": ("local", "ray")},
    workers=whole_number(1, 4096, "isn't a number of processes; 1 or more"),
    level=_probability, tolerance_mm=positive_number, tolerance_deg=positive_number, dataset=str, address=str,
)  # fmt: skip
def dataset(arguments: Arguments) -> int:
    """Where was the wrist camera in each episode of a dataset?  For every episode and camera: cam_T_grip with
    its covariance and protection level, whether the camera moved within it (when, how far, why), which
    episodes share one mounting, and which fraction of the frames is usable.  DATASET is a folder or a URL
    (s3://bucket/folder) with LeRobot datasets, .mcap files, rosbag2 folders, folders of images or videos,
    and is never modified.  Below DIR:

      stretches/camera=NAME/part-0.parquet   a row for each stretch without motion, failures included
      report.html                            mountings over time, failures, the worst episodes
      episodes-…/                            a file for each measured episode: a new call measures only the rest
    """
    from gripmon.daemon.dataset import measure_dataset

    if (arguments.tolerance_mm is None) != (arguments.tolerance_deg is None):
        raise InputError("--tolerance-mm and --tolerance-deg belong together; both, or neither")
    with progress_bar(None, "episode") as step:
        found = measure_dataset(
            arguments.dataset,
            arguments.out,
            arguments.config,
            cameras=arguments.camera or (),
            lens="config" if arguments.own_lens else "file",
            engine=arguments.engine or "local",
            workers=arguments.workers,
            address=arguments.address,
            level=arguments.level or 0.01,
            tolerance_m=arguments.metres("tolerance_mm") or 0.0,
            tolerance_rad=arguments.radians("tolerance_deg") or 0.0,
            step=step,
        )
    good = found.episodes - found.failed
    counts = f"{found.episodes} episodes, {found.measured} measured now, {found.failed} without a transform"
    note([f"dataset: {counts}; {found.table}, {found.report}"])
    return EXIT_DONE if good else EXIT_FAILED
