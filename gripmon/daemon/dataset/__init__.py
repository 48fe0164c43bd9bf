"""A whole dataset: every episode and wrist camera measured, on this machine or a cluster, into one table."""

from gripmon.daemon.dataset.surveying import Survey, measure_dataset

__all__ = ["Survey", "measure_dataset"]
