"""Choice of target cameras: candidates, gains and a greedy plan."""
