"""What a run leaves behind: readings and commands, trajectories, a recording for rerun."""
