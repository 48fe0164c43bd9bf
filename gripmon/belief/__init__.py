"""Where the gripper stands and what may be wrong, as probabilities."""
