"""What every part stands on: errors, progress, threads, memory, timing, files, jobs, plug-ins."""
